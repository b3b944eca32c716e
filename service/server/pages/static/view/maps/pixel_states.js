/** What is known of each pixel: solved, unsure (there is an estimate, which is not vouched for), refused (there is none), or outside. */

const SOLVED = 0;
export const UNSURE = 1;
export const REFUSED = 2;
export const OUTSIDE = 3;

/**
 * Return the state of every pixel of a tile.
 * @param {any} codes Of view.json.
 * @param {import("../view_file.js").Tile|null} status Null: the view has no status; then only the mask tells.
 * @param {import("../view_file.js").Tile} mask
 * @returns {Uint8Array}
 */
export function statesOf(codes, status, mask) {
  const states = new Uint8Array(mask.rows * mask.cols);
  for (let at = 0; at < states.length; at += 1) states[at] = stateOf(codes, status?.planes[0][at], mask.planes[0][at]);
  return states;
}

/** Return the state of a pixel with a status code (undefined: not known) and a value of the mask. */
export function stateOf(codes, code, mask) {
  if (mask > 0.5) return SOLVED;
  if (code === undefined || Math.round(code) === 0) return OUTSIDE;
  return codes[Math.round(code)]?.estimate ? UNSURE : REFUSED;
}

/** Return the words of a status code. */
export function codeWords(codes, code) {
  const found = codes[Math.round(code)];
  return found === undefined ? `code ${code}` : (found.meaning ?? found.name.replaceAll("_", " ")).replace(/\.$/, "");
}

/**
 * Return an image of a tile's pixels of one state: opaque there, clear elsewhere.
 * @param {Uint8Array} states
 * @param {number} cols
 * @param {number} wanted
 * @returns {ImageData|null} Null: the tile has no such pixel.
 */
export function stencil(states, cols, wanted) {
  if (!states.includes(wanted)) return null;
  const image = new ImageData(cols, states.length / cols);
  for (let at = 0; at < states.length; at += 1) image.data[4 * at + 3] = states[at] === wanted ? 255 : 0;
  return image;
}
