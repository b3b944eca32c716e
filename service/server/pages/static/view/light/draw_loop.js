/**
 * When pictures are drawn, and how large: reduced while something moves, as far as this machine needs it for thirty a second, and whole when it is still.
 * The page never waits for the graphics processor, which may be a program on the processor: a fence says when a drawing is done, and a whole picture is
 * drawn in bands, so that a new motion waits for one band at most.
 */

import { DrawSpeed } from "./draw_speed.js";

const MOTION_MS = 22; // that a picture may take while something moves: thirty a second, with the rest of the page
const BAND_MS = 25; // that a band of a whole picture may take
const STILL_MS = 150; // without a change, after which the whole picture is drawn
const LOOK_MS = 4; // between two looks whether a drawing is done
const LEAST_PIXELS = 30_000; // of a picture while something moves: of fewer too little is seen

export class DrawLoop {
  #renderer;
  #shown;
  #picture = null;
  #changedAt = 0;
  #isMoved = false; // something has changed since the last drawing
  #row = 0; // of the whole picture, up to which it is drawn
  #pending = null; // the drawing under way
  #asked = false;
  #waiting = []; // who wait for the whole picture
  #speed = new DrawSpeed();

  /**
   * @param {import("./basis_renderer.js").BasisRenderer} renderer
   * @param {function(number): void} shown Is told when a picture is done: of how many pixels of the capture in a row one is drawn.
   */
  constructor(renderer, shown) {
    this.#renderer = renderer;
    this.#shown = shown;
  }

  /** Draw a picture soon. */
  ask(picture) {
    this.#picture = picture;
    this.#changedAt = performance.now();
    this.#isMoved = true;
    this.#row = 0;
    this.#next();
  }

  /** Return when the whole picture is shown. */
  settled() {
    const isIdle = !this.#isMoved && this.#pending === null && this.#row === this.#renderer.relight.rows;
    return isIdle ? Promise.resolve() : new Promise((resolve) => { this.#waiting.push(resolve); });
  }

  /** Draw the whole picture now, however long it takes. */
  drawNow(picture) {
    this.#picture = picture;
    this.#renderer.draw(picture);
    [this.#isMoved, this.#row, this.#pending] = [false, this.#renderer.relight.rows, null];
    this.#end(1);
  }

  /** Forget what is to be drawn. */
  stop() {
    this.#picture = null;
  }

  #next() {
    if (this.#asked) return;
    this.#asked = true;
    const step = () => {
      this.#asked = false;
      this.#step();
    };
    if (this.#pending === null) requestAnimationFrame(step);
    else setTimeout(step, LOOK_MS);
  }

  #step() {
    if (this.#picture === null) return;
    const { rows, cols } = this.#renderer.relight;
    if (this.#pending !== null && !this.#isOver()) return void this.#next();
    if (this.#isMoved) {
      const stride = Math.max(1, Math.ceil(Math.sqrt((rows * cols) / Math.max(this.#speed.pixelsIn(MOTION_MS), LEAST_PIXELS))));
      this.#isMoved = false;
      this.#row = stride === 1 ? rows : 0;
      this.#begin({ stride }, (rows * cols) / stride ** 2, () => { this.#end(stride); this.#next(); });
    } else if (this.#row < rows) {
      if (performance.now() - this.#changedAt < STILL_MS) return void this.#next();
      const from = this.#row;
      this.#row = Math.min(rows, from + Math.max(1, Math.floor(this.#speed.pixelsIn(BAND_MS) / cols)));
      this.#begin({ band: [from, this.#row], isSame: from > 0 }, (this.#row - from) * cols, () => (this.#row === rows ? this.#end(1) : this.#next()));
    }
    return undefined;
  }

  #begin(how, pixels, done) {
    const began = performance.now();
    this.#renderer.draw({ ...this.#picture, ...how });
    this.#pending = { fence: this.#renderer.fence(), began, pixels, done };
    this.#next();
  }

  /** Return whether the drawing under way is over, and take over what it tells. */
  #isOver() {
    const { fence, began, pixels, done } = this.#pending;
    if (!this.#renderer.isPast(fence)) return false;
    this.#speed.add(pixels, Math.max(1, performance.now() - began));
    this.#pending = null;
    done();
    return true;
  }

  #end(stride) {
    this.#shown(stride);
    if (stride > 1) return;
    for (const resolve of this.#waiting.splice(0)) resolve();
  }
}
