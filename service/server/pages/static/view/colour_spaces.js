/** Scene-linear colour spaces: what a file declares, and conversion between them. */

import { spaces, tolerance, undeclared, writtenByOiio } from "./colour_table.js";

const UNITY = [1, 0, 0, 0, 1, 0, 0, 0, 1];

/** The space of the screen. */
export const DISPLAY_SPACE = "lin_rec709_scene";

/**
 * Return the matrix from a space to another, row by row.
 * @param {string} from @param {string} to Names of the Color Interop Forum.
 * @throws {Error} A space is not known; a sentence.
 */
export function matrixBetween(from, to) {
  if (from === to) return UNITY;
  return product(inverse(matrixOf(to)), matrixOf(from));
}

/** Return a colour multiplied by a matrix; no channel is below 0, as in frames that are rendered. */
export function converted(matrix, [r, g, b]) {
  return [0, 3, 6].map((row) => Math.max(0, matrix[row] * r + matrix[row + 1] * g + matrix[row + 2] * b));
}

/**
 * Return the space that the header of an EXR file declares, as the server finds it.
 * @param {any} header As EXRLoader of three.js returns it.
 * @throws {Error} The chromaticities are those of no known space; a sentence.
 */
export function declaredSpace(header) {
  if (!undeclared.includes(header.colorInteropID ?? undeclared[0])) return header.colorInteropID;
  if (header.chromaticities === undefined) return writtenByOiio[String(header["oiio:ColorSpace"]).toLowerCase()] ?? DISPLAY_SPACE;
  const given = ["red", "green", "blue", "white"].flatMap((name) => [header.chromaticities[`${name}X`], header.chromaticities[`${name}Y`]]);
  for (const [name, { chromaticities }] of Object.entries(spaces)) {
    if (chromaticities?.every((value, index) => Math.abs(value - given[index]) <= tolerance)) return name;
  }
  throw new Error("has chromaticities of no known colour space: convert it to Rec.709, Rec.2020, P3-D65, ACEScg or ACES2065-1");
}

/** Add a space of an OpenColorIO configuration, with its matrix to linear Rec.709, row by row. */
export function addSpace(name, toRec709) {
  spaces[name] = { toRec709, chromaticities: null };
}

function matrixOf(space) {
  if (!(space in spaces)) throw new Error(`${space} is not a scene-linear colour space that these pages know`);
  return spaces[space].toRec709;
}

function product(a, b) {
  return a.map((_, at) => [0, 1, 2].reduce((sum, k) => sum + a[3 * Math.floor(at / 3) + k] * b[3 * k + (at % 3)], 0));
}

function inverse(m) {
  const cofactor = (row, col) => {
    const at = (i, j) => m[3 * ((row + i) % 3) + ((col + j) % 3)];
    return at(1, 1) * at(2, 2) - at(1, 2) * at(2, 1);
  };
  const determinant = [0, 1, 2].reduce((sum, col) => sum + m[col] * cofactor(0, col), 0);
  return m.map((_, at) => cofactor(at % 3, Math.floor(at / 3)) / determinant);
}
