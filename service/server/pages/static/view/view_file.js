/**
 * The files that `relit view` writes (docs/view.md): view.json, and blocks of view.bin, which are read piece by piece.
 */

import { addSpace } from "./colour_spaces.js";

const MOST_BETWEEN = 1 << 16; // bytes that are rather read in vain than asked around
const KEPT_TILES = 192; // of 256 × 256 × 3 floats: 150 MB

/** A tile of a layer. @typedef {{rows: number, cols: number, planes: Float32Array[]}} Tile */

/** An opened view. */
export class ViewFile {
  #files;
  #tiles = new Map();

  /**
   * Open a view.
   * @param {{json: function(string): Promise<any>, bytes: function(string, number=, number=): Promise<ArrayBuffer>}} files
   */
  static async open(files) {
    const info = await files.json("view.json");
    if (info.schema !== "relit.view/1") throw new Error(`the view has the schema ${info.schema}, these pages know relit.view/1`);
    if (info.to_rec709) addSpace(info.color_space, info.to_rec709);
    return new ViewFile(info, files);
  }

  constructor(info, files) {
    this.info = info;
    this.#files = files;
  }

  /** Return a layer by name; undefined: the view has none. */
  layer(name) {
    return this.info.layers.find((layer) => layer.name === name);
  }

  /** Return the bytes of a block. */
  block(place) {
    return this.blocks([place])[0];
  }

  /** Return the bytes of blocks as promises; those that lie beside each other come with one request. */
  blocks(places) {
    const parts = []; // of the file
    for (const [offset, length] of places.toSorted((one, other) => one[0] - other[0])) {
      const last = parts.at(-1);
      if (last !== undefined && offset - last.end <= MOST_BETWEEN) last.end = offset + length;
      else parts.push({ begin: offset, end: offset + length });
    }
    for (const part of parts) part.bytes = this.raw(part.begin, part.end - part.begin);
    const found = places.map(async ([offset, length]) => {
      const { begin, bytes } = parts.findLast((part) => part.begin <= offset);
      return inflated(new Uint8Array(await bytes, offset - begin, length));
    });
    for (const each of found) each.catch(() => {}); // whoever waits for it is told
    return found;
  }

  /** Return bytes of view.bin as they are. */
  raw(offset, length) {
    return this.#files.bytes("view.bin", offset, length);
  }

  /** Return the thumbnails of the frames in one image. */
  thumbnails() {
    return picture(this.#files, "thumbnails.jpg");
  }

  /** Return the object under a light from above right of the camera, a small picture. */
  card() {
    return cardOf(this.#files);
  }

  /**
   * Return a tile of a layer; the tiles that were used last are kept.
   * @param {any} layer Of view.json.
   * @param {number} level 0 is the whole resolution.
   * @param {number} index In the rows of tiles.
   * @returns {Promise<Tile>}
   */
  tile(layer, level, index) {
    const key = `${layer.name}/${level}/${index}`;
    let found = this.#tiles.get(key);
    this.#tiles.delete(key);
    found ??= this.#read(layer, level, index).catch((error) => {
      this.#tiles.delete(key); // so that it is asked for again
      throw error;
    });
    this.#tiles.set(key, found);
    if (this.#tiles.size > KEPT_TILES) this.#tiles.delete(this.#tiles.keys().next().value);
    return found;
  }

  async #read(layer, level, index) {
    const { rows, cols, tile, tiles } = layer.levels[level];
    const across = Math.ceil(cols / tile);
    const size = { rows: Math.min(tile, rows - Math.floor(index / across) * tile), cols: Math.min(tile, cols - (index % across) * tile) };
    const values = floats(await this.block(tiles[index]), layer.dtype);
    const count = size.rows * size.cols;
    return { ...size, planes: layer.channels.map((_, channel) => values.subarray(channel * count, (channel + 1) * count)) };
  }

  /**
   * Return the values of a pixel at the whole resolution.
   * @returns {Promise<number[]>} One for each channel of the layer.
   */
  async pixel(layer, row, col) {
    const { cols, tile } = layer.levels[0];
    const found = await this.tile(layer, 0, Math.floor(row / tile) * Math.ceil(cols / tile) + Math.floor(col / tile));
    return found.planes.map((plane) => plane[(row % tile) * found.cols + (col % tile)]);
  }
}

/** Return the object under a light from above right of the camera, from the files of a view; an earlier build has made none. */
export function cardOf(files) {
  return picture(files, "card.jpg");
}

async function picture(files, name) {
  return createImageBitmap(new Blob([await files.bytes(name)], { type: "image/jpeg" }));
}

function inflated(packed) {
  return new Response(new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"))).arrayBuffer();
}

/** Return numbers of a block as floats. */
export function floats(buffer, dtype) {
  if (dtype === "float32") return new Float32Array(buffer);
  if (dtype !== "float16") throw new Error(`the view has numbers of the type ${dtype}, which these pages do not know`);
  const halves = new Uint16Array(buffer);
  const values = new Float32Array(halves.length);
  for (let at = 0; at < halves.length; at += 1) values[at] = HALVES[halves[at]];
  return values;
}

/** All half floats, by their bits. */
const HALVES = (() => {
  const table = new Float32Array(1 << 16);
  for (let bits = 0; bits < table.length; bits += 1) {
    const exponent = (bits >> 10) & 31;
    const fraction = bits & 1023;
    const size = exponent === 0 ? fraction * 2 ** -24 : exponent === 31 ? (fraction === 0 ? Infinity : NaN) : (1 + fraction / 1024) * 2 ** (exponent - 15);
    table[bits] = bits & 0x8000 ? -size : size;
  }
  return table;
})();
