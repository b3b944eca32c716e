/** Values as colours of the screen: named colour maps for numbers, and a named view transform for scene-linear colours. */

import { converted, DISPLAY_SPACE, matrixBetween } from "./colour_spaces.js";

const ANCHORS = { // matplotlib's viridis at every sixteenth
  viridis: "440154 48186a 472d7b 424086 3b528b 33638d 2c728e 26828e 21918c 1fa088 28ae80 3fbc73 5ec962 84d44b addc30 d8e219 fde725",
  grey: "000000 ffffff",
};
const STEPS = 256;
const VEIL = 128;
const MOST_VEILED = 235;

/** Names of the colour maps. */
export const COLOUR_MAPS = Object.keys(ANCHORS);
/** Name of the view transform, as pages show it. */
export const VIEW_TRANSFORM = "sRGB (linear Rec.709, clipped, no tone mapping)";
/** Colours of codes, which differ for people with any colour vision as far as nine colours can (Okabe and Ito 2008, and grey). */
const CODE_COLOURS = ["009e73", "e69f00", "56b4e9", "f0e442", "0072b2", "d55e00", "cc79a7", "777777", "202020"].map(bytesOf);

function bytesOf(hex) {
  return [0, 2, 4].map((at) => parseInt(hex.slice(at, at + 2), 16));
}

const tables = new Map();

/** Return the 256 × 3 bytes of a colour map. */
export function colourTable(name) {
  if (!tables.has(name)) {
    const anchors = ANCHORS[name].split(" ").map(bytesOf);
    const table = new Uint8ClampedArray(3 * STEPS);
    for (let step = 0; step < STEPS; step += 1) {
      const at = (step / (STEPS - 1)) * (anchors.length - 1);
      const low = Math.min(Math.floor(at), anchors.length - 2);
      for (let c = 0; c < 3; c += 1) table[3 * step + c] = anchors[low][c] + (at - low) * (anchors[low + 1][c] - anchors[low][c]);
    }
    tables.set(name, table);
  }
  return tables.get(name);
}

/** Return the colour of a code beside others as bytes; null: the code 0, which stands for nothing. */
export function codeColour(codes, code) {
  return code === 0 ? null : CODE_COLOURS[codes.filter((each) => each !== 0).indexOf(code) % CODE_COLOURS.length] ?? CODE_COLOURS.at(-1);
}

/** Return the byte of a linear value, encoded as sRGB does (IEC 61966-2-1). */
export function srgbByte(linear) {
  return ENCODED[Math.max(0, Math.min(4095, Math.round(linear * 4095)))];
}

const ENCODED = Uint8ClampedArray.from({ length: 4096 }, (_, index) => {
  const value = index / 4095;
  return Math.round(255 * (value <= 0.0031308 ? 12.92 * value : 1.055 * value ** (1 / 2.4) - 0.055));
});

/**
 * Paint a tile.
 * @param {any} layer Of view.json.
 * @param {import("./view_file.js").Tile} tile
 * @param {{low: number, high: number, codes: number[], stops: number, colours: string, space: string, veil?: "low"|"high"}} look `veil`: numbers become a
 *     grey that covers the more, the lower or the higher they are.
 * @returns {ImageData}
 */
export function paint(layer, tile, look) {
  const image = new ImageData(tile.cols, tile.rows);
  const { data } = image;
  const count = tile.rows * tile.cols;
  const [x, y, z] = tile.planes;
  if (layer.kind === "vector") {
    for (let at = 0, to = 0; at < count; at += 1, to += 4) {
      data[to] = 127.5 * (x[at] + 1);
      data[to + 1] = 127.5 * (y[at] + 1);
      data[to + 2] = 127.5 * (z[at] + 1);
      data[to + 3] = 255;
    }
  } else if (layer.kind === "colour") {
    const gain = 2 ** look.stops;
    const m = matrixBetween(look.space, DISPLAY_SPACE);
    for (let at = 0, to = 0; at < count; at += 1, to += 4) {
      const [r, g, b] = converted(m, [x[at], y[at], z[at]]);
      data[to] = srgbByte(gain * r);
      data[to + 1] = srgbByte(gain * g);
      data[to + 2] = srgbByte(gain * b);
      data[to + 3] = 255;
    }
  } else if (layer.kind === "codes") {
    for (let at = 0, to = 0; at < count; at += 1, to += 4) {
      const colour = codeColour(look.codes, Math.round(x[at]));
      if (colour !== null) data.set([...colour, 255], to);
    }
  } else if (look.veil !== undefined) {
    for (let at = 0, to = 0; at < count; at += 1, to += 4) {
      const share = Math.max(0, Math.min(1, (x[at] - look.low) / (look.high - look.low || 1)));
      data.set([VEIL, VEIL, VEIL, MOST_VEILED * (look.veil === "low" ? 1 - share : share)], to);
    }
  } else {
    const table = colourTable(look.colours);
    const scale = (STEPS - 1) / (look.high - look.low || 1);
    for (let at = 0, to = 0; at < count; at += 1, to += 4) {
      const step = 3 * Math.max(0, Math.min(STEPS - 1, Math.round((x[at] - look.low) * scale)));
      data[to] = table[step];
      data[to + 1] = table[step + 1];
      data[to + 2] = table[step + 2];
      data[to + 3] = 255;
    }
  }
  return image;
}
