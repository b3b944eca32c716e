/** Lat-long environment maps from files: OpenEXR and Radiance HDR, by the loaders of three.js, which are loaded when they are needed. */

import { element } from "../../element.js";
import { converted, declaredSpace, DISPLAY_SPACE, matrixBetween } from "../colour_spaces.js";
import { srgbByte } from "../display.js";

const PREVIEW_COLS = 256;

/**
 * Read a map.
 * @param {ArrayBuffer} buffer Of the file.
 * @param {string} name Of the file, whose end says the format.
 * @param {string} space Of the radiance that is returned.
 * @returns {Promise<{rows: number, cols: number, pixels: Float32Array, space: string}>} Radiance [rows, cols, 3], from the top; no channel is below 0.
 * @throws {Error} The file is no environment map, or its colour space is not known; a sentence.
 */
export async function readEnvironment(buffer, name, space) {
  const { FloatType } = await import("three");
  const isExr = /\.exr$/i.test(name);
  const { EXRLoader, HDRLoader } = isExr ? await import("three/addons/loaders/EXRLoader.js") : await import("three/addons/loaders/HDRLoader.js");
  let found;
  try {
    found = (isExr ? new EXRLoader() : new HDRLoader()).setDataType(FloatType).parse(buffer);
  } catch (error) {
    throw new Error(`${name}: cannot be read as an environment map: ${error.message ?? error}`);
  }
  const { width: cols, height: rows, data } = found;
  if (cols !== 2 * rows) throw new Error(`${name}: is ${cols} × ${rows}: a lat-long map is twice as wide as it is high`);
  const channels = data.length / (rows * cols);
  const matrix = matrixOf(found.header, isExr, name, space);
  const pixels = new Float32Array(3 * rows * cols);
  let wrong = 0;
  for (let row = 0; row < rows; row += 1) {
    const from = isExr ? rows - 1 - row : row; // the EXR loader gives the lowest row first
    for (let col = 0; col < cols; col += 1) {
      const at = (from * cols + col) * channels;
      const value = [0, 1, 2].map((c) => data[at + Math.min(c, channels - 1)]);
      wrong += value.every(Number.isFinite) ? 0 : 1;
      pixels.set(converted(matrix, value), 3 * (row * cols + col));
    }
  }
  if (wrong > 0) throw new Error(`${name}: ${wrong} pixels are no numbers`);
  return { rows, cols, pixels, space };
}

/** Return the matrix from the space that a file declares; Radiance files are Rec.709. */
function matrixOf(header, isExr, name, space) {
  try {
    return matrixBetween(isExr ? declaredSpace(header) : DISPLAY_SPACE, space);
  } catch (error) {
    throw new Error(`${name}: ${error.message}`);
  }
}

/** Return a small picture of a map. */
export function previewOf({ rows, cols, pixels, space }) {
  const matrix = matrixBetween(space, DISPLAY_SPACE);
  const canvas = element("canvas", { width: Math.min(cols, PREVIEW_COLS), height: Math.min(rows, PREVIEW_COLS / 2), class: "preview", role: "img", "aria-label": "Environment map" });
  const image = new ImageData(canvas.width, canvas.height);
  for (let row = 0; row < canvas.height; row += 1) {
    for (let col = 0; col < canvas.width; col += 1) {
      const at = 3 * (Math.floor((row * rows) / canvas.height) * cols + Math.floor((col * cols) / canvas.width));
      const to = 4 * (row * canvas.width + col);
      const shown = converted(matrix, pixels.subarray(at, at + 3));
      for (let c = 0; c < 3; c += 1) image.data[to + c] = srgbByte(shown[c]);
      image.data[to + 3] = 255;
    }
  }
  canvas.getContext("2d").putImageData(image, 0, 0);
  return canvas;
}
