/** A capture under a light that follows the pointer, and turns slowly while nobody points. */

import { byId, tell } from "../element.js";
import { mount } from "../view/light/relight_viewer.js";
import { ViewFile } from "../view/view_file.js";

const DEGREES_PER_S = 24;
const FROM_AXIS = 0.7; // sine of the angle between the turning light and the view axis
const PICTURE_MS = 66;
const REST_MS = 3000; // after the pointer has gone or a key was pressed
const STEP = 0.1;
const KEYS = { ArrowLeft: [-STEP, 0], ArrowRight: [STEP, 0], ArrowUp: [0, STEP], ArrowDown: [0, -STEP] };

/** Return the direction, of the half sphere towards the camera, at a place of the unit disc. */
function towards(x, y) {
  const across = Math.hypot(x, y);
  const scale = across > 0.95 ? 0.95 / across : 1;
  return [x * scale, y * scale, Math.sqrt(1 - (scale * across) ** 2)];
}

/**
 * Show a view.
 * @param {HTMLElement} parent Takes it.
 * @param {any} files Of the view.
 * @returns {Promise<{destroy: function(): void}|null>} null: it has too few lights to be relit.
 */
export async function mountTurning(parent, files) {
  const view = await ViewFile.open(files);
  if (view.info.relight === null) return null;
  const viewer = await mount(parent, view, { environments: [], load: () => tell("none"), onchange: () => {}, embedded: true });
  const canvas = parent.querySelector("canvas.picture");
  if (canvas === null) return null; // without WebGL the viewer says so
  canvas.setAttribute("aria-label", "The object under a light that follows the pointer. Arrow keys move the light.");
  const still = globalThis.matchMedia("(prefers-reduced-motion: reduce)");
  const button = byId("turn");
  let turns = !still.matches;
  let degrees = 0;
  let before = performance.now();
  let resting = 0; // until when
  let asked = null;

  function say() {
    button.setAttribute("aria-pressed", String(turns));
    canvas.dataset.turns = String(turns);
  }

  function step(time) {
    asked = requestAnimationFrame(step);
    if (time - before < PICTURE_MS) return;
    if (turns && time > resting) {
      degrees += (Math.min(time - before, 500) / 1000) * DEGREES_PER_S;
      const angle = (degrees * Math.PI) / 180;
      viewer.set(towards(FROM_AXIS * Math.cos(angle), FROM_AXIS * Math.sin(angle)));
    }
    before = time;
  }

  const rest = () => { resting = performance.now() + REST_MS; };
  const toggle = () => { turns = !turns; say(); };
  const calm = () => { turns = turns && !still.matches; say(); };
  canvas.addEventListener("pointermove", (event) => {
    rest();
    const box = canvas.getBoundingClientRect();
    const half = Math.min(box.width, box.height) / 2;
    viewer.set(towards((event.clientX - box.left - box.width / 2) / half, (box.top + box.height / 2 - event.clientY) / half));
  });
  canvas.addEventListener("keydown", (event) => {
    const moved = KEYS[event.key];
    if (moved === undefined) return;
    event.preventDefault();
    rest();
    const [x, y] = viewer.state().light.direction;
    viewer.set(towards(x + moved[0], y + moved[1]));
  });
  button.addEventListener("click", toggle);
  still.addEventListener("change", calm);
  say();
  asked = requestAnimationFrame(step);
  globalThis.relit = viewer;
  return {
    destroy() {
      cancelAnimationFrame(asked);
      button.removeEventListener("click", toggle);
      still.removeEventListener("change", calm);
      viewer.destroy();
    },
  };
}
