/** A picture of the object that stands on the canvas of a 3D scene until the scene is drawn. */

import { painted } from "../breath.js";

/**
 * Show a picture in the middle of a canvas of the page, as large as it fits, and return when it is seen.
 * @param {HTMLCanvasElement} canvas
 * @param {ImageBitmap} picture
 */
export function showPoster(canvas, picture) {
  const { clientWidth: width, clientHeight: height } = canvas;
  [canvas.width, canvas.height] = [width, height];
  const scale = Math.min(width / picture.width, height / picture.height);
  const [across, down] = [scale * picture.width, scale * picture.height];
  canvas.getContext("2d").drawImage(picture, (width - across) / 2, (height - down) / 2, across, down);
  canvas.dataset.shown = "card";
  return painted();
}
