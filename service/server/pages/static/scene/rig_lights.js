/** The lights of the rig as small markers around an object, which covers those that are before and behind it: spheres for distant lights, octahedra for near ones. */

import { Group, Mesh, MeshBasicMaterial, OctahedronGeometry, Raycaster, SphereGeometry } from "three";

const DISTANCE = 1.7; // of the markers from the middle of the object, in its radii
const SIZE = 0.014;
const CHOSEN = 2; // times as large

export class RigLights {
  #group = new Group();
  #markers = new Map();

  /**
   * @param {{frame: any, index: number}[]} lights Frames of view.json that have a direction, with their places there.
   * @param {import("three").Vector3} center Of the object.
   * @param {number} radius Of the object.
   * @param {{light: string, suspect: string}} colours Of CSS.
   */
  constructor(lights, center, radius, colours) {
    const shapes = { near: new OctahedronGeometry(1.3 * SIZE * radius), far: new SphereGeometry(SIZE * radius, 12, 8) };
    const material = (color) => new MeshBasicMaterial({ color, toneMapped: false, depthTest: false, depthWrite: false });
    const materials = { light: material(colours.light), suspect: material(colours.suspect) };
    this.#group.position.copy(center);
    for (const { frame, index } of lights) {
      const marker = new Mesh(frame.near ? shapes.near : shapes.far, frame.suspect === null ? materials.light : materials.suspect);
      marker.position.set(...frame.direction).multiplyScalar(DISTANCE * radius);
      marker.userData.index = index;
      marker.renderOrder = -1; // the object is drawn over it
      this.#group.add(marker);
      this.#markers.set(index, marker);
    }
  }

  /** The markers, for a scene. */
  get object() {
    return this.#group;
  }

  /** Make one marker larger than the others; null: none. */
  choose(chosen) {
    for (const [index, marker] of this.#markers) marker.scale.setScalar(index === chosen ? CHOSEN : 1);
  }

  /**
   * Return the index of the light whose marker is at a place of the picture; null: there is none.
   * @param {import("three").Vector3} place x and y from -1 to 1.
   * @param {import("three").Camera} camera
   * @param {import("three").Object3D} object That covers markers.
   */
  at(place, camera, object) {
    if (!this.#group.visible) return null;
    const caster = new Raycaster();
    caster.setFromCamera(place, camera);
    if (caster.intersectObject(object).length > 0) return null;
    return caster.intersectObject(this.#group)[0]?.object.userData.index ?? null;
  }
}
