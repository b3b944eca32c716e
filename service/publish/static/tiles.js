/** The tiles of coefficient planes that a view needs: which they are, and those that have been loaded. */

const SIDE = 256;
const KEPT = 120; // of 256 × 256 × 9 × 4 bytes: 280 MB; more only where one picture needs more
const AGAIN_MS = 5000;

export class Tiles {
  #loaded = new Map();
  #wanted = new Set();
  #info;
  #renderer;
  #changed;
  #failed;

  /** `changed` is called when a tile has come, `failed` with the error where one cannot be had. */
  constructor(info, renderer, changed, failed) {
    [this.#info, this.#renderer, this.#changed, this.#failed] = [info, renderer, changed, failed];
    this.coarsest = Math.max(0, Math.ceil(Math.log2(Math.max(info.width, info.height) / SIDE)));
  }

  /**
   * Return the tiles to draw, coarse ones first, and whether they are all that belong to the picture; ask for those that are missing.
   * @param {{left: number, top: number, right: number, bottom: number}} part Of the image, pixels.
   * @param {number} scale Device pixels per pixel of the image.
   */
  covering(part, scale) {
    const halving = Math.min(this.coarsest, Math.max(0, Math.round(-Math.log2(scale))));
    const found = new Map();
    const wanted = [[this.coarsest, 0, 0]];
    const side = SIDE * 2 ** halving;
    for (let row = Math.max(0, Math.floor(part.top / side)); row * side < Math.min(part.bottom, this.#info.height); row += 1) {
      for (let column = Math.max(0, Math.floor(part.left / side)); column * side < Math.min(part.right, this.#info.width); column += 1) {
        wanted.push([halving, column, row]);
      }
    }
    this.#wanted = new Set(wanted.map((each) => each.join("/")));
    for (const [first, column, row] of wanted) {
      for (let up = 0; first + up <= this.coarsest; up += 1) {
        const key = [first + up, column >> up, row >> up].join("/");
        const tile = this.#loaded.get(key);
        if (up === 0 && tile === undefined) this.#load(key, first, column, row);
        if (tile?.texture === undefined) continue;
        this.#loaded.delete(key);
        this.#loaded.set(key, tile); // used last
        found.set(key, tile);
        break;
      }
    }
    const whole = [...this.#wanted].every((key) => this.#loaded.get(key)?.texture !== undefined);
    return { whole, shown: [...found.values()].sort((a, b) => b.halving - a.halving) };
  }

  async #load(key, halving, column, row) {
    const tile = { halving, box: this.#box(halving, column, row) };
    this.#loaded.set(key, tile);
    try {
      const urls = Array.from({ length: this.#renderer.terms }, (_, j) => `plane_${j}_files/${this.coarsest - halving}/${column}_${row}.jpg`);
      tile.texture = this.#renderer.texture(await Promise.all(urls.map(bitmapOf)));
    } catch (error) {
      setTimeout(() => { // it is asked for again
        this.#loaded.delete(key);
        this.#changed();
      }, AGAIN_MS);
      this.#failed(error);
      return;
    }
    for (const [old, { texture }] of this.#loaded) {
      if (this.#loaded.size <= KEPT) break;
      if (texture === undefined || this.#wanted.has(old)) continue;
      this.#renderer.forget(texture);
      this.#loaded.delete(old);
    }
    this.#changed();
  }

  /** Return left, top, right and bottom of a tile in pixels of the image. */
  #box(halving, column, row) {
    const side = SIDE * 2 ** halving;
    return [column * side, row * side, Math.min((column + 1) * side, this.#info.width), Math.min((row + 1) * side, this.#info.height)];
  }
}

async function bitmapOf(url) {
  const response = await fetch(url);
  if (!response.ok) throw new Error(`${url} cannot be read (${response.status}).`);
  return createImageBitmap(await response.blob(), { colorSpaceConversion: "none", premultiplyAlpha: "none" });
}
