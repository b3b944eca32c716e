/** A 3D scene on a canvas that is orbited by pointer, touch and keyboard, and drawn when something has changed. */

import { Box3, PerspectiveCamera, Scene, Sphere, Vector3, WebGLRenderer } from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";
import { element } from "../element.js";
import { SceneLoop } from "./scene_loop.js";

const FIELD_OF_VIEW = 35; // degrees, of a lens that distorts shapes little
const MARGIN = 1.15; // around the bounding sphere
const STEP = Math.PI / 36; // of an arrow key
const PAN = 0.05; // of the height of the canvas, for an arrow key with Shift
const ZOOM = 1.15; // of plus and minus
const LARGEST_RATIO = 2; // pixels of the canvas per CSS pixel: more is not seen and costs time
const DRAG_PX = 4; // a pointer that moves farther than this does not click
const KEYS = "Arrow keys turn it, with Shift they move it, plus and minus zoom, 0 shows the first view.";

export class OrbitScene {
  #controls;
  #loop;
  #observer;
  #pressed = null;

  /**
   * @param {HTMLElement} parent Takes the canvas.
   * @param {string} label What the canvas shows.
   * @param {{onclick?: function(Vector3): void, ondraw?: function(): void, onfault?: function(string): void}} [options] `onclick` is given
   *     x and y of a click from -1 to 1, to the right and up; `ondraw` is called before a picture is drawn; `onfault` is told when the graphics processor fails.
   */
  constructor(parent, label, { onclick = () => {}, ondraw = () => {}, onfault = () => {} } = {}) {
    this.canvas = element("canvas", { class: "scene", tabindex: 0, role: "img", "aria-label": `${label}. ${KEYS}` });
    parent.append(this.canvas);
    this.renderer = new WebGLRenderer({ antialias: true, alpha: true, preserveDrawingBuffer: true });
    this.#loop = new SceneLoop(this.renderer, this.canvas, () => this.#render());
    this.scene = new Scene();
    this.camera = new PerspectiveCamera(FIELD_OF_VIEW);
    this.ondraw = ondraw;
    this.#controls = new OrbitControls(this.camera, this.canvas);
    this.#controls.addEventListener("change", () => this.changed());
    this.canvas.addEventListener("keydown", (event) => this.#key(event));
    this.canvas.addEventListener("pointerdown", (event) => { this.#pressed = [event.clientX, event.clientY]; });
    this.canvas.addEventListener("click", (event) => {
      if (this.#pressed === null || Math.hypot(event.clientX - this.#pressed[0], event.clientY - this.#pressed[1]) > DRAG_PX) return;
      const box = this.canvas.getBoundingClientRect();
      onclick(new Vector3((2 * (event.clientX - box.left)) / box.width - 1, 1 - (2 * (event.clientY - box.top)) / box.height, 0));
    });
    const drawn = this.renderer.domElement;
    drawn.addEventListener("webglcontextlost", () => onfault("The graphics processor has stopped. The picture comes back when it does; else load the page again."));
    drawn.addEventListener("webglcontextrestored", () => { onfault(""); this.changed(); });
    this.#observer = new ResizeObserver(() => this.#resize());
    this.#observer.observe(this.canvas);
    this.onclick = onclick;
  }

  /**
   * Look along -z at the middle of objects, from so far that all of it is seen; this becomes the view that the key 0 shows.
   * @param {import("three").Object3D} object
   */
  frame(object) {
    object.updateWorldMatrix(true, true);
    const sphere = new Box3().setFromObject(object).getBoundingSphere(new Sphere());
    this.radius = sphere.radius > 0 ? sphere.radius : 1;
    const narrow = Math.min(1, this.camera.aspect || 1);
    const distance = (MARGIN * this.radius) / Math.sin((FIELD_OF_VIEW * Math.PI) / 360) / narrow;
    this.#controls.target.copy(sphere.center);
    this.camera.position.copy(sphere.center).add(new Vector3(0, 0, distance));
    this.#controls.update();
    this.#controls.saveState();
    this.center = sphere.center.clone();
    this.changed();
  }

  /** Draw soon. */
  changed() {
    this.#loop.changed();
  }

  /** Return when what is shown is whole. */
  settled() {
    return this.#loop.settled();
  }

  #render() {
    const distance = this.camera.position.distanceTo(this.#controls.target);
    this.camera.near = distance / 100;
    this.camera.far = distance + 20 * (this.radius ?? 1);
    this.camera.updateProjectionMatrix();
    this.ondraw();
    this.renderer.render(this.scene, this.camera);
  }

  /**
   * Draw, and return what is shown.
   * @returns {{rows: number, cols: number, pixels: Uint8Array}} RGBA [rows, cols, 4] as encoded for the screen, from the top, premultiplied.
   */
  picture() {
    this.#loop.drawNow();
    const gl = this.renderer.getContext();
    const [cols, rows] = [gl.drawingBufferWidth, gl.drawingBufferHeight];
    const flipped = new Uint8Array(4 * rows * cols);
    gl.readPixels(0, 0, cols, rows, gl.RGBA, gl.UNSIGNED_BYTE, flipped);
    const pixels = new Uint8Array(flipped.length);
    for (let row = 0; row < rows; row += 1) pixels.set(flipped.subarray(4 * cols * (rows - 1 - row), 4 * cols * (rows - row)), 4 * cols * row);
    return { rows, cols, pixels };
  }

  /** Where the camera stands and what it looks at, from the middle of the object, in its radii: six numbers. */
  get place() {
    return [this.camera.position, this.#controls.target].flatMap((each) => each.clone().sub(this.center).divideScalar(this.radius).toArray());
  }

  set place(numbers) {
    [this.camera.position, this.#controls.target].forEach((each, at) => each.fromArray(numbers, 3 * at).multiplyScalar(this.radius).add(this.center));
    this.#controls.update();
    this.changed();
  }

  /** Call a function when the camera has moved. */
  onmove(action) {
    this.#controls.addEventListener("change", action);
  }

  /** Show the first view again. */
  reset() {
    this.#controls.reset();
    this.changed();
  }

  /** Give everything back. */
  destroy() {
    this.#loop.stop();
    this.#observer.disconnect();
    this.#controls.dispose();
    release(this.scene);
    this.renderer.dispose();
    this.renderer.forceContextLoss();
    this.canvas.remove();
  }

  #resize() {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    if (width === 0 || height === 0) return;
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, LARGEST_RATIO));
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    this.changed();
  }

  #key(event) {
    if (event.ctrlKey || event.altKey || event.metaKey) return;
    const pan = PAN * this.canvas.clientHeight;
    const controls = this.#controls;
    const move = (x, y) => (event.shiftKey ? controls.pan(-pan * x, -pan * y) : (controls.rotateLeft(STEP * x), controls.rotateUp(STEP * y)));
    const actions = {
      ArrowLeft: () => move(-1, 0), ArrowRight: () => move(1, 0), ArrowUp: () => move(0, -1), ArrowDown: () => move(0, 1),
      "+": () => controls.dollyIn(1 / ZOOM), "=": () => controls.dollyIn(1 / ZOOM), "-": () => controls.dollyIn(ZOOM), 0: () => this.reset(),
      Enter: () => this.onclick(new Vector3(0, 0, 0)),
    };
    const action = actions[event.key];
    if (action === undefined) return;
    event.preventDefault();
    action();
    this.changed();
  }
}

/** Give back the memory of geometries, materials and textures. */
function release(root) {
  root.traverse((node) => {
    node.geometry?.dispose();
    for (const material of [node.material].flat()) {
      for (const value of Object.values(material ?? {})) if (value?.isTexture) value.dispose();
      material?.dispose();
    }
  });
}
