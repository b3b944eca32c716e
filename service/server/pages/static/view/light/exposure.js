/** The exposure at which all but the brightest pixels of a picture are below white, from some of its pixels. */

import { floats } from "../view_file.js";

const WHITE_PERCENTILE = 0.99;
const SAMPLES = 2000; // pixels that are looked at

export class Exposure {
  #relight;
  #places;
  #tiles; // that each place lies in
  #terms = []; // colours of each term at the places

  /**
   * @param {any} relight Of view.json.
   * @param {Uint8Array} matte Coverage [rows, cols].
   * @param {Uint16Array} tiles Index of each tile.
   */
  constructor(relight, matte, tiles) {
    const { cols, tiles: { side, cols: across } } = relight;
    this.#relight = relight;
    this.#places = spread(matte);
    this.#tiles = this.#places.map((place) => tiles[Math.floor(Math.floor(place / cols) / side) * across + Math.floor((place % cols) / side)]);
  }

  /** Take a coefficient image: half floats [3, pixels]. */
  setTerm(term, planes) {
    const count = planes.length / 3;
    const chosen = Uint16Array.from(this.#places.flatMap((place) => [planes[place], planes[count + place], planes[2 * count + place]]));
    this.#terms[term] = floats(chosen.buffer, "float16");
  }

  /** Return the stops for coefficients [tiles, terms, 3], in tenths; null: there is no light. */
  stops(coefficients) {
    const levels = this.#places.map((_, index) => {
      const from = 3 * this.#relight.terms * this.#tiles[index];
      return Math.max(...[0, 1, 2].map((c) => this.#terms.reduce((sum, term, k) => sum + coefficients[from + 3 * k + c] * term[3 * index + c], 0)));
    });
    const white = levels.sort((a, b) => a - b)[Math.floor(WHITE_PERCENTILE * (levels.length - 1))];
    return white > 0 ? Math.round(-10 * Math.log2(white)) / 10 : null;
  }
}

/** Return the places of covered pixels, evenly spread. */
function spread(matte) {
  let inside = 0;
  for (const cover of matte) if (cover === 255) inside += 1;
  const step = Math.max(1, Math.floor(inside / SAMPLES));
  const places = [];
  for (let at = 0, index = 0; at < matte.length; at += 1) {
    if (matte[at] !== 255) continue;
    if (index % step === 0) places.push(at);
    index += 1;
  }
  return places;
}
