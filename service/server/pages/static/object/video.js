/** Videos of what a canvas shows, recorded by the browser in what it can encode. */

import { attempt } from "../api.js";
import { element } from "../element.js";

const FORMATS = ["video/webm;codecs=vp9", "video/webm", "video/mp4"];
const SECONDS = 6;
const PICTURES_PER_S = 30;
const LAST_MS = 250; // a recorder that stops at once leaves out what was drawn last
const BITS_PER_S = 8_000_000;

/**
 * Offer a video of the object while its light turns once around.
 * @param {HTMLElement|null} tools Takes the button; null: there is no picture.
 * @param {string} name Of the object.
 * @param {{canvas: HTMLCanvasElement, turn: function(number): void}} viewer
 */
export function mountVideo(tools, name, viewer) {
  let before = 0;
  if (tools !== null) offerVideo(tools, name, viewer.canvas, SECONDS, (share) => {
    viewer.turn(360 * (share - before));
    before = share < 1 ? share : 0;
  });
}

/**
 * Offer a video where the browser can record one.
 * @param {HTMLElement} tools Takes the button.
 * @param {string} name Of the file, without its suffix.
 * @param {HTMLCanvasElement} canvas
 * @param {number} seconds How long it is.
 * @param {function(number): Promise<void>|void} show Shows the picture at a share of the video, 0 to 1; where it takes time, pictures are left out.
 */
export function offerVideo(tools, name, canvas, seconds, show) {
  const format = FORMATS.find((each) => globalThis.MediaRecorder?.isTypeSupported(each));
  if (format === undefined) return;
  const button = element("button", { type: "button", class: "quiet", onclick: () => attempt(async () => {
    button.disabled = true;
    try {
      const told = async (share) => { await show(share); button.textContent = `Recording ${Math.round(100 * share)} %`; };
      save(await recorded(canvas, format, seconds, told), `${name}.${format.slice(6).split(";")[0]}`);
    } finally {
      button.disabled = false;
      button.textContent = "Save a video";
    }
  }) }, "Save a video");
  tools.append(button);
}

/** Return what a canvas shows while `show` is called with shares of the time from 0 to 1. */
function recorded(canvas, format, seconds, show) {
  return new Promise((resolve, reject) => {
    const parts = [];
    const recorder = new MediaRecorder(canvas.captureStream(PICTURES_PER_S), { mimeType: format, videoBitsPerSecond: BITS_PER_S });
    recorder.addEventListener("dataavailable", ({ data }) => parts.push(data));
    recorder.addEventListener("stop", () => resolve(new Blob(parts, { type: format })));
    recorder.addEventListener("error", () => { reject(new Error("the browser cannot record what it shows")); });
    recorder.start();
    const began = performance.now();
    const step = async (now) => {
      const share = Math.min(1, Math.max(0, now - began) / (1000 * seconds));
      await show(share);
      if (share < 1) requestAnimationFrame(again);
      else setTimeout(() => recorder.stop(), LAST_MS);
    };
    const again = (now) => step(now).catch(reject);
    requestAnimationFrame(again);
  });
}

function save(blob, name) {
  const address = URL.createObjectURL(blob);
  element("a", { href: address, download: name }).click();
  setTimeout(() => URL.revokeObjectURL(address), 60_000);
}
