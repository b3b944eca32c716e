/** A video of the object while its light turns once around, recorded by the browser from what it shows. */

import { attempt } from "../api.js";
import { element } from "../element.js";

const FORMATS = ["video/webm;codecs=vp9", "video/webm", "video/mp4"];
const SECONDS = 6;
const PICTURES_PER_S = 30;
const BITS_PER_S = 8_000_000;

/**
 * Offer the video where the browser can record one.
 * @param {HTMLElement|null} tools Takes the button; null: there is no picture.
 * @param {string} name Of the object.
 * @param {{canvas: HTMLCanvasElement, turn: function(number): void}} viewer
 */
export function mountVideo(tools, name, viewer) {
  const format = FORMATS.find((each) => globalThis.MediaRecorder?.isTypeSupported(each));
  if (tools === null || format === undefined) return;
  const button = element("button", { type: "button", class: "quiet", onclick: () => attempt(async () => {
    button.disabled = true;
    try {
      save(await recorded(viewer, format, (share) => { button.textContent = `Recording ${Math.round(100 * share)} %`; }), `${name}.${format.slice(6).split(";")[0]}`);
    } finally {
      button.disabled = false;
      button.textContent = "Save a video";
    }
  }) }, "Save a video");
  tools.append(button);
}

/** Turn the light once around, and return what is seen meanwhile. */
function recorded(viewer, format, progress) {
  return new Promise((resolve, reject) => {
    const parts = [];
    const recorder = new MediaRecorder(viewer.canvas.captureStream(PICTURES_PER_S), { mimeType: format, videoBitsPerSecond: BITS_PER_S });
    recorder.addEventListener("dataavailable", ({ data }) => parts.push(data));
    recorder.addEventListener("stop", () => resolve(new Blob(parts, { type: format })));
    recorder.addEventListener("error", () => { reject(new Error("the browser cannot record what it shows")); });
    recorder.start();
    const began = performance.now();
    let before = 0;
    const step = (now) => {
      const share = Math.min(1, Math.max(0, now - began) / (1000 * SECONDS));
      viewer.turn(360 * (share - before));
      before = share;
      progress(share);
      if (share < 1) requestAnimationFrame(step);
      else recorder.stop();
    };
    requestAnimationFrame(step);
  });
}

function save(blob, name) {
  const address = URL.createObjectURL(blob);
  element("a", { href: address, download: name }).click();
  setTimeout(() => URL.revokeObjectURL(address), 60_000);
}
