/** The distance between two points of an object, which are chosen one after the other. */

import { BufferGeometry, Group, Line, LineBasicMaterial, Points, PointsMaterial, Raycaster } from "three";

const POINT_PX = 9;

/** Return a length in metres as a person reads it. */
export function lengthText(metres) {
  const [unit, factor] = metres >= 1 ? ["m", 1] : metres >= 0.01 ? ["cm", 100] : metres >= 1e-3 ? ["mm", 1000] : ["µm", 1e6];
  return `${(metres * factor).toPrecision(4)} ${unit}`;
}

export class Distance {
  #object;
  #points = [];
  #shown = new Group();
  #materials;

  /** @param {import("three").Object3D} object That is measured. @param {string} colour Of CSS. */
  constructor(object, colour) {
    this.#object = object;
    this.#materials = [new PointsMaterial({ color: colour, size: POINT_PX, sizeAttenuation: false, depthTest: false, toneMapped: false }),
      new LineBasicMaterial({ color: colour, depthTest: false, toneMapped: false })];
  }

  /** The points and the line between them, for a scene. */
  get shown() {
    return this.#shown;
  }

  /** Return the distance in units of the scene; null: there are not two points yet. */
  get value() {
    return this.#points.length === 2 ? this.#points[0].distanceTo(this.#points[1]) : null;
  }

  /**
   * Take the point of the object at a place of the picture; a third one begins again.
   * @returns {number|null} How many points there are now; null: the object is not there.
   */
  take(place, camera) {
    const caster = new Raycaster();
    caster.setFromCamera(place, camera);
    const [hit] = caster.intersectObject(this.#object);
    if (hit === undefined) return null;
    if (this.#points.length === 2) this.#points = [];
    this.#points.push(hit.point);
    this.#draw();
    return this.#points.length;
  }

  /** Forget the points. */
  clear() {
    this.#points = [];
    this.#draw();
  }

  #draw() {
    for (const each of this.#shown.children) each.geometry.dispose();
    this.#shown.clear();
    if (this.#points.length === 0) return;
    const geometry = new BufferGeometry().setFromPoints(this.#points);
    this.#shown.add(new Points(geometry, this.#materials[0]), new Line(geometry, this.#materials[1]));
    for (const each of this.#shown.children) each.renderOrder = 1; // over the object
  }
}
