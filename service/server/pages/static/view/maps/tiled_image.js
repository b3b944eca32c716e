/** A layer of a view as an image: tiles of the level that fits, painted when they arrive, with hatching where pixels are unsure or refused. */

import { paint } from "../display.js";
import { OUTSIDE, REFUSED, statesOf, stencil, UNSURE } from "./pixel_states.js";

const KEPT = 256;
const HATCH_PX = 8;

export class TiledImage {
  #view;
  #changed;
  #painted = new Map();
  #failed;

  /**
   * @param {import("../view_file.js").ViewFile} view
   * @param {any} layer Of view.json.
   * @param {function(): void} changed Called when something new can be drawn.
   * @param {function(Error): void} failed Called when a tile cannot be had.
   */
  constructor(view, layer, changed, failed) {
    this.#view = view;
    this.layer = layer;
    this.#changed = changed;
    this.#failed = failed;
    const [low, high] = layer.kind === "codes" || layer.range.length < 2 ? [0, 1] : layer.range;
    this.look = { low, high, codes: layer.range, stops: 0, colours: "viridis", space: view.info.color_space };
  }

  /** Return the values of a pixel at the whole resolution. */
  pixel(row, col) {
    return this.#view.pixel(this.layer, row, col);
  }

  /** Change how values are shown. */
  setLook(changes) {
    this.look = { ...this.look, ...changes };
    this.#painted.clear();
    this.#changed();
  }

  /**
   * Draw the image.
   * @param {CanvasRenderingContext2D} context
   * @param {{x: number, y: number, scale: number}} place Left, top and canvas pixels per image pixel.
   * @param {{left: number, right: number}} part Columns of the canvas that are drawn.
   * @param {{unsure: boolean, refused: boolean}} hatched
   */
  draw(context, place, part, hatched) {
    const level = this.#levelFor(place.scale);
    const { rows, cols, tile } = this.layer.levels[level];
    const [full] = this.layer.levels;
    const across = Math.ceil(cols / tile);
    const size = [place.scale * full.cols / cols, place.scale * full.rows / rows]; // canvas pixels per pixel of the level
    const height = context.canvas.height;
    context.save();
    context.beginPath();
    context.rect(part.left, 0, part.right - part.left, height);
    context.clip();
    context.imageSmoothingEnabled = place.scale < 1;
    for (let index = 0; index < this.layer.levels[level].tiles.length; index += 1) {
      const col = (index % across) * tile;
      const row = Math.floor(index / across) * tile;
      const box = [place.x + col * size[0], place.y + row * size[1], Math.min(tile, cols - col) * size[0], Math.min(tile, rows - row) * size[1]];
      if (box[0] > part.right || box[0] + box[2] < part.left || box[1] > height || box[1] + box[3] < 0) continue;
      const painted = this.#tile(level, index);
      if (painted === null) continue;
      context.drawImage(painted.image, ...box);
      if (hatched.unsure) this.#hatch(context, painted.unsure, box, "#ffffff", "#000000", 1);
      if (hatched.refused) this.#hatch(context, painted.refused, box, "#ff4d4d", "#400000", -1);
    }
    context.restore();
  }

  #levelFor(scale) {
    let level = 0;
    while (level + 1 < this.layer.levels.length && scale * this.layer.levels[0].cols / this.layer.levels[level + 1].cols <= 1) level += 1;
    return level;
  }

  #tile(level, index) {
    const key = `${level}/${index}`;
    const found = this.#painted.get(key);
    if (found !== undefined) return found instanceof Promise ? null : found;
    const pending = this.#paint(level, index).then((painted) => {
      if (this.#painted.get(key) !== pending) return; // the look has changed meanwhile
      this.#painted.set(key, painted);
      if (this.#painted.size > KEPT) this.#painted.delete(this.#painted.keys().next().value);
      this.#changed();
    }, (error) => {
      if (this.#painted.get(key) === pending) this.#painted.delete(key);
      this.#failed(error);
    });
    this.#painted.set(key, pending);
    return null;
  }

  async #paint(level, index) {
    const { layer, look } = this;
    const tile = await this.#view.tile(layer, level, index);
    const pixels = paint(layer, tile, look);
    const mask = this.#view.layer("mask");
    if (mask === undefined) return { image: await createImageBitmap(pixels), unsure: null, refused: null };
    const status = this.#view.layer("status");
    const states = statesOf(this.#view.info.codes, status === undefined ? null : await this.#view.tile(status, level, index),
      await this.#view.tile(mask, level, index));
    if (layer.kind !== "mask") states.forEach((state, at) => { if (state === OUTSIDE) pixels.data[4 * at + 3] = 0; });
    const stencils = [UNSURE, REFUSED].map((wanted) => stencil(states, tile.cols, wanted));
    const [image, unsure, refused] = await Promise.all([pixels, ...stencils].map((each) => (each === null ? null : createImageBitmap(each))));
    return { image, unsure, refused };
  }

  /** Draw diagonal lines of two colours where a stencil is opaque, so that they are seen on any image. */
  #hatch(context, shape, box, light, dark, slope) {
    if (shape === null) return;
    const [left, top] = [Math.max(0, Math.floor(box[0])), Math.max(0, Math.floor(box[1]))];
    const width = Math.min(context.canvas.width, Math.ceil(box[0] + box[2])) - left;
    const height = Math.min(context.canvas.height, Math.ceil(box[1] + box[3])) - top;
    if (width <= 0 || height <= 0) return;
    const scratch = new OffscreenCanvas(width, height);
    const pen = scratch.getContext("2d");
    pen.imageSmoothingEnabled = false;
    pen.drawImage(shape, box[0] - left, box[1] - top, box[2], box[3]);
    pen.globalCompositeOperation = "source-in";
    pen.translate(-left, -top); // lines go on from tile to tile
    pen.fillStyle = pen.createPattern(hatching(light, dark, slope), "repeat");
    pen.fillRect(left, top, width, height);
    context.drawImage(scratch, left, top);
  }
}

const patterns = new Map();

function hatching(light, dark, slope) {
  const key = `${light}${dark}${slope}`;
  if (!patterns.has(key)) {
    const canvas = new OffscreenCanvas(HATCH_PX, HATCH_PX);
    const pen = canvas.getContext("2d");
    for (let y = 0; y < HATCH_PX; y += 1) {
      for (let x = 0; x < HATCH_PX; x += 1) {
        const across = (((x + slope * y) % HATCH_PX) + HATCH_PX) % HATCH_PX;
        if (across >= 4) continue;
        pen.fillStyle = across < 2 ? light : dark;
        pen.fillRect(x, y, 1, 1);
      }
    }
    patterns.set(key, canvas);
  }
  return patterns.get(key);
}
