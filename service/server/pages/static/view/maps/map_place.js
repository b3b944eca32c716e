/** Where a map lies on its canvas: zoomed and moved by pointers, fingers, wheel and keys, and kept in the address. */

import { Address } from "../../publish/address.js";

const LARGEST_SCALE = 64;
const CLICK_PX = 4; // a pointer that moves farther than this does not click

export const ZOOM = 1.25;

export class MapPlace {
  /** Canvas pixels: left, top, and those of a pixel of the map. */
  now = { x: 0, y: 0, scale: 1 };
  #address = new Address({ "map-centre": 2, "map-zoom": 1 });
  #canvas;
  #changed;
  #isBeside;
  #size;

  /**
   * @param {HTMLCanvasElement} canvas
   * @param {{rows: number, cols: number}} size Of the map.
   * @param {{isBeside: function(): boolean, changed: function(): void}} page Whether two maps stand side by side, each in its half; what is done when the place has changed.
   */
  constructor(canvas, { rows, cols }, { isBeside, changed }) {
    this.#canvas = canvas;
    this.#size = [cols, rows];
    this.#isBeside = isBeside;
    this.#changed = changed;
  }

  /** Return the scale at which all is seen. */
  #fitting() {
    return Math.min(this.#canvas.width / (this.#isBeside() ? 2 : 1) / this.#size[0], this.#canvas.height / this.#size[1]);
  }

  #put(scale, [col, row]) {
    this.now = { scale, x: this.#canvas.width / 2 - scale * col, y: this.#canvas.height / 2 - scale * row };
    this.#changed();
  }

  /** Show all. */
  fit() {
    this.#put(this.#fitting(), this.#size.map((side) => side / 2));
    this.#address.write({});
  }

  /** Show what the address says, else all; on a canvas of another size too. */
  restore() {
    const given = {};
    this.#address.read(given);
    const { "map-centre": centre = this.#size.map((side) => side / 2), "map-zoom": zoom = 1 } = given;
    const fitting = this.#fitting();
    this.#put(Math.min(Math.max(0.5, zoom) * fitting, Math.max(LARGEST_SCALE, fitting)), centre.map((value, axis) => Math.min(Math.max(0, value), this.#size[axis])));
  }

  /** Zoom about a place of the canvas. */
  zoom(factor, x = this.#canvas.width / 2, y = this.#canvas.height / 2) {
    const { now } = this;
    const scale = Math.max(this.#fitting() / 2, Math.min(LARGEST_SCALE, now.scale * factor));
    this.now = { scale, x: x - ((x - now.x) * scale) / now.scale, y: y - ((y - now.y) * scale) / now.scale };
    this.#moved();
  }

  /** Move by canvas pixels. */
  pan(x, y) {
    this.now = { ...this.now, x: this.now.x + x, y: this.now.y + y };
    this.#moved();
  }

  #moved() {
    const { scale, x, y } = this.now;
    const { width, height } = this.#canvas;
    this.#address.write({ "map-centre": [(width / 2 - x) / scale, (height / 2 - y) / scale], "map-zoom": scale / this.#fitting() });
    this.#changed();
  }

  /** Return row and column of the pixel at a place of the canvas; null: there is none. */
  pixelAt(x, y) {
    const { width } = this.#canvas;
    const shift = this.#isBeside() ? ((x < width / 2 ? -1 : 1) * width) / 4 : 0;
    const [row, col] = [Math.floor((y - this.now.y) / this.now.scale), Math.floor((x - this.now.x - shift) / this.now.scale)];
    return row < 0 || col < 0 || row >= this.#size[1] || col >= this.#size[0] ? null : [row, col];
  }

  /**
   * Follow pointers: one moves the map, two zoom it.
   * @param {{pointed: function(number, number): void, clicked: function(number, number): void}} told Places of the canvas that were pointed at, and clicked.
   */
  listen({ pointed, clicked }) {
    const canvas = this.#canvas;
    const down = new Map(); // places of the pointers that are down
    let path = 0; // of the pointers since the first came down
    const at = (event) => {
      const box = canvas.getBoundingClientRect();
      return [((event.clientX - box.left) * canvas.width) / box.width, ((event.clientY - box.top) * canvas.height) / box.height];
    };
    canvas.addEventListener("pointerdown", (event) => {
      if (down.size === 0) path = 0;
      down.set(event.pointerId, at(event));
      canvas.setPointerCapture(event.pointerId);
    });
    canvas.addEventListener("pointermove", (event) => {
      const place = at(event);
      const before = down.get(event.pointerId);
      if (before === undefined) return pointed(...place);
      const moved = [place[0] - before[0], place[1] - before[1]];
      path += Math.hypot(...moved);
      down.set(event.pointerId, place);
      if (path <= CLICK_PX) return undefined;
      const other = [...down].find(([id]) => id !== event.pointerId)?.[1];
      this.pan(...moved.map((each) => each / down.size));
      if (other !== undefined) {
        const [apart, wasApart] = [place, before].map(([x, y]) => Math.hypot(x - other[0], y - other[1]));
        if (wasApart > 0) this.zoom(apart / wasApart, (place[0] + other[0]) / 2, (place[1] + other[1]) / 2);
      }
      return pointed(...place);
    });
    for (const name of ["pointerup", "pointercancel"]) {
      canvas.addEventListener(name, (event) => {
        if (name === "pointerup" && down.size === 1 && path <= CLICK_PX) clicked(...at(event));
        down.delete(event.pointerId);
      });
    }
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoom(event.deltaY < 0 ? ZOOM : 1 / ZOOM, ...at(event));
    }, { passive: false });
  }
}
