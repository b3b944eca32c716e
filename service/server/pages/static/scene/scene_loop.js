/**
 * When a 3D scene is drawn and shown. It is drawn on a canvas that is not on the page, and copied to the page when a fence says that it is done: a browser without a
 * graphics card else waits, and the page with it, until the program in place of one has compiled its shaders and drawn. While something moves, it is drawn in fewer pixels.
 */

const MOTION_MS = 30; // that a picture may take while something moves
const STILL_MS = 150; // without a change, after which all pixels are drawn
const LOOK_MS = 4; // between two looks whether a drawing is done
const LEAST_SHARE = 1 / 8; // of the pixels in a row that are drawn while something moves
const LEARNED = 0.3; // weight of a drawing in what is known of the speed

export class SceneLoop {
  #renderer;
  #canvas;
  #render;
  #isChanged = false;
  #changedAt = 0;
  #share = 0; // of the pixels in a row that is shown
  #pixelsPerMs = null;
  #pending = null; // the drawing under way
  #asked = false;
  #isStopped = false;
  #waiting = []; // who wait for the whole picture

  /**
   * @param {import("three").WebGLRenderer} renderer That keeps what it has drawn.
   * @param {HTMLCanvasElement} canvas Of the page, for a 2D context.
   * @param {function(): void} render Draws the scene.
   */
  constructor(renderer, canvas, render) {
    this.#renderer = renderer;
    this.#canvas = canvas;
    this.#render = render;
    renderer.domElement.addEventListener("webglcontextlost", () => { this.#pending = null; this.#share = 0; }); // its fence will never tell
  }

  /** Draw soon. */
  changed() {
    this.#isChanged = true;
    this.#changedAt = performance.now();
    this.#next();
  }

  /** Draw all pixels now, however long it takes, and show them later. */
  drawNow() {
    this.#begin(1);
  }

  /** Return when all pixels are shown. */
  settled() {
    const isIdle = !this.#isChanged && this.#pending === null && this.#share === 1;
    return isIdle ? Promise.resolve() : new Promise((resolve) => { this.#waiting.push(resolve); });
  }

  /** Draw no more. */
  stop() {
    this.#isStopped = true;
  }

  #next() {
    if (this.#asked || this.#isStopped) return;
    this.#asked = true;
    const step = () => {
      this.#asked = false;
      if (!this.#isStopped) this.#step();
    };
    if (this.#pending === null) requestAnimationFrame(step);
    else setTimeout(step, LOOK_MS);
  }

  #step() {
    if (this.#pending !== null && !this.#isOver()) return void this.#next();
    if (this.#isChanged) this.#begin(this.#motionShare());
    else if (this.#share < 1 && performance.now() - this.#changedAt >= STILL_MS) this.#begin(1);
    else if (this.#share < 1) this.#next();
    else for (const resolve of this.#waiting.splice(0)) resolve();
    return undefined;
  }

  #motionShare() {
    const { width, height } = this.#renderer.domElement;
    const share = this.#pixelsPerMs === null ? LEAST_SHARE : Math.sqrt((this.#pixelsPerMs * MOTION_MS) / (width * height));
    return Math.max(LEAST_SHARE, Math.min(1, share));
  }

  #begin(share) {
    const gl = this.#renderer.getContext();
    if (gl.isContextLost()) return; // changed() is called when it is back
    const { width, height } = this.#renderer.domElement;
    if (this.#pending !== null) gl.deleteSync(this.#pending.fence);
    const size = [Math.max(1, Math.round(share * width)), Math.max(1, Math.round(share * height))];
    const ratio = this.#renderer.getPixelRatio();
    this.#renderer.setViewport(0, 0, size[0] / ratio, size[1] / ratio);
    this.#isChanged = false;
    const began = performance.now();
    this.#render();
    const fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
    this.#pending = { fence, share, size, began, of: [width, height] };
    this.#next();
  }

  /** Return whether the drawing under way is over, and show it then. */
  #isOver() {
    const gl = this.#renderer.getContext();
    const { fence, share, size, began, of } = this.#pending;
    if (!gl.isContextLost() && gl.getSyncParameter(fence, gl.SYNC_STATUS) !== gl.SIGNALED) return false;
    gl.deleteSync(fence);
    this.#pending = null;
    const { width, height } = this.#renderer.domElement;
    if (gl.isContextLost() || of[0] !== width || of[1] !== height) return true; // nothing is drawn there any more
    const speed = (size[0] * size[1]) / Math.max(1, performance.now() - began);
    this.#pixelsPerMs = this.#pixelsPerMs === null ? speed : this.#pixelsPerMs + LEARNED * (speed - this.#pixelsPerMs);
    this.#share = share;
    this.#copy(size);
    return true;
  }

  #copy([width, height]) {
    const drawn = this.#renderer.domElement;
    if (this.#canvas.width !== drawn.width || this.#canvas.height !== drawn.height) [this.#canvas.width, this.#canvas.height] = [drawn.width, drawn.height];
    const pen = this.#canvas.getContext("2d");
    pen.globalCompositeOperation = "copy";
    pen.drawImage(drawn, 0, drawn.height - height, width, height, 0, 0, drawn.width, drawn.height);
    Object.assign(this.#canvas.dataset, { share: this.#share, shown: "live" });
  }
}
