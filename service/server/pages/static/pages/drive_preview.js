/** What is predicted of a drive: the balls and the object that the lamps light, and the environment as it turns. */

import { element, numberOf } from "../element.js";
import { BasisRenderer, canRender } from "../view/light/basis_renderer.js";
import { converted, DISPLAY_SPACE, matrixBetween } from "../view/colour_spaces.js";
import { srgbByte, VIEW_TRANSFORM } from "../view/display.js";
import { previewOf, readEnvironment } from "../view/light/environment_map.js";
import { LightModel } from "../view/light/light_model.js";

const SIDE = 120; // of a ball, pixels
const GREY = 0.6; // of the brightest place of the matte ball over all frames, before the display transform
const LAMP_COSINE = Math.cos((4 * Math.PI) / 180); // half the width at which the mirror ball shows a lamp

function dot(a, b) {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

/** Return the normals of a ball seen from +z, and where each lies in a square picture. */
function ballNormals() {
  const found = [];
  for (let at = 0; at < SIDE * SIDE; at += 1) {
    const x = (2 * (at % SIDE) + 1) / SIDE - 1;
    const y = 1 - (2 * Math.floor(at / SIDE) + 1) / SIDE;
    const rest = 1 - x * x - y * y;
    if (rest > 0) found.push({ at, normal: [x, y, Math.sqrt(rest)] });
  }
  return found;
}

/** Return the irradiance of a surface under lamps. */
function irradianceOf(normal, directions, light) {
  const sum = [0, 0, 0];
  directions.forEach((direction, index) => {
    const cosine = dot(normal, direction);
    if (cosine > 0) light[index].forEach((value, channel) => { sum[channel] += cosine * value; });
  });
  return sum;
}

/** Return the nearest direction to a vector, by its index, and the cosine to it. */
function nearestOf(vector, directions) {
  return directions.reduce((best, direction, index) => {
    const cosine = dot(vector, direction);
    return cosine > best.cosine ? { index, cosine } : best;
  }, { index: 0, cosine: -2 });
}

/**
 * Show a matte ball and a mirror ball under the lamps.
 * @param {HTMLElement} parent Takes them.
 * @param {number[][]} directions To each lamp.
 * @param {number[][][]} frames The light of each lamp in each frame, in `space`; the brightest of them sets the exposure of all.
 * @param {string} space Scene-linear.
 * @returns {function(number): void} Shows a frame, by its place.
 */
export function mountBalls(parent, directions, frames, space) {
  const matrix = matrixBetween(space, DISPLAY_SPACE);
  const pixels = ballNormals().map(({ at, normal }) => {
    const mirrored = nearestOf([2 * normal[2] * normal[0], 2 * normal[2] * normal[1], 2 * normal[2] ** 2 - 1], directions);
    return { at, normal, lamp: mirrored.cosine > LAMP_COSINE ? mirrored.index : null };
  });
  const coarse = pixels.filter((_, index) => index % 97 === 0);
  const most = Math.max(...frames.flatMap((light) => coarse.flatMap(({ normal }) => irradianceOf(normal, directions, light))), 1e-30);
  const canvases = ["Matte ball", "Mirror ball"].map((name) => element("canvas", { width: SIDE, height: SIDE, role: "img", "aria-label": `${name} under the lamps` }));
  parent.replaceChildren(...canvases);
  return (place) => {
    const light = frames[place];
    const images = canvases.map(() => new ImageData(SIDE, SIDE));
    const put = (image, at, colour, gain) => image.data.set([...converted(matrix, colour).map((value) => srgbByte(gain * value)), 255], 4 * at);
    for (const { at, normal, lamp } of pixels) {
      put(images[0], at, irradianceOf(normal, directions, light), GREY / most);
      put(images[1], at, lamp === null ? [0, 0, 0] : light[lamp], (GREY / most) / (2 * (1 - LAMP_COSINE)));
    }
    canvases.forEach((canvas, index) => canvas.getContext("2d").putImageData(images[index], 0, 0));
  };
}

/**
 * Show the environment as it turns.
 * @param {{name: string, data: ArrayBuffer}} file Of the environment.
 * @param {number} step Degrees from frame to frame.
 * @returns {Promise<function(number): void>} Shows a frame, by its place.
 */
export async function mountEnvironment(parent, file, step) {
  const still = previewOf(await readEnvironment(file.data, file.name, DISPLAY_SPACE));
  const canvas = element("canvas", { width: still.width, height: still.height, class: "preview", role: "img", "aria-label": "Environment as it turns" });
  parent.replaceChildren(canvas);
  return (place) => {
    // from +z, the middle, towards +x, a quarter from the left edge
    const left = -(((((step * place) / 360) % 1) + 1) % 1) * still.width;
    for (const at of [left, left + still.width]) canvas.getContext("2d").drawImage(still, at, 0);
  };
}

/**
 * Show a capture under the lamps: each stands for the captured light that is nearest, as for `relit twin`.
 * @param {HTMLElement} parent Takes the picture.
 * @param {import("../view/view_file.js").ViewFile} view Of the capture.
 * @param {number[][]} directions To each lamp.
 * @param {number[][][]} frames As of `mountBalls`.
 * @param {string} space Of the light, scene-linear.
 * @returns {Promise<function(number): void>} Shows a frame, by its place.
 * @throws {Error} The capture cannot be relit, or this browser cannot; a sentence.
 */
export async function mountObject(parent, view, directions, frames, space) {
  const { relight } = view.info;
  if (relight === null) throw new Error("this capture has too few lights to relight it: four or more are needed");
  if (!canRender()) throw new Error("This browser has no WebGL2, which the picture of the object needs.");
  const lights = view.info.frames.filter((frame) => frame.direction !== null);
  const { quadrature } = relight;
  const [inverse, beyond, outside, captured, index, matte] = await Promise.all(
    view.blocks([quadrature.inverse, quadrature.beyond, quadrature.outside, relight.captured, relight.tiles.index, relight.matte]));
  const model = new LightModel(relight, { inverse: new Float64Array(inverse), beyond: new Float32Array(beyond), outside: new Float32Array(outside), captured: new Uint16Array(captured) }, lights);
  const canvas = element("canvas", { class: "picture", width: relight.cols, height: relight.rows, role: "img", "aria-label": `${view.info.name} under the lamps` });
  const stops = element("input", { type: "range", min: -10, max: 10, step: 0.1, value: 0, "aria-label": "Exposure of the object in stops" });
  const renderer = new BasisRenderer(canvas, relight, view.info.color_space);
  renderer.setTiles(new Uint16Array(index));
  renderer.setMatte(new Uint8Array(matte));
  for (const [term, block] of relight.basis.entries()) await renderer.setTerm(term, new Uint16Array(await view.block(block)));
  const matrix = matrixBetween(space, view.info.color_space);
  const nearest = directions.map((direction) => nearestOf(direction, lights.map((each) => each.direction)).index);
  let shown = 0;
  const draw = (place) => {
    shown = place;
    const weights = lights.map(() => [0, 0, 0]);
    nearest.forEach((light, lamp) => converted(matrix, frames[place][lamp]).forEach((value, channel) => {
      weights[light][channel] += value / lights[light].irradiance[channel];
    }));
    renderer.draw({ shown: model.ofCaptured(weights), compared: null, border: 1, gain: 2 ** Number(stops.value), backdrop: [0.2, 0.2, 0.2] });
  };
  stops.addEventListener("input", () => draw(shown));
  parent.replaceChildren(canvas, element("label", {}, "Exposure (stops) ", stops, " ", numberOf(stops)), element("p", { class: "help" }, `Shown through ${VIEW_TRANSFORM}.`));
  canvas.dataset.ready = "";
  return draw;
}
