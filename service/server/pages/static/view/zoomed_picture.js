/** A picture that is zoomed, moved, lit by dragging and shown on the full screen, with a scale bar where the size of its pixels is known. */

import { element } from "../element.js";
import { listen } from "../publish/gestures.js";
import { showScale } from "../publish/overlay.js";

const ZOOM = 1.5;
const FINER = 2; // pixels of the canvas in a row for each of a picture that is reduced while it moves: the browser enlarges them faster
const LABEL = "The object under the chosen light. Drag or use the arrow keys to move the light, with Shift to move the picture; plus and minus zoom, 0 shows all.";

/**
 * Show a canvas.
 * @param {HTMLElement} stage Takes the picture, and becomes the full screen.
 * @param {HTMLCanvasElement} source Is shown, as large as the state says or smaller.
 * @param {import("../publish/view_state.js").ViewState} state Of the picture.
 * @param {{changed: function(object): void, pixelSize: number|null, still: boolean}} options `changed` is given what gestures change of the state; `pixelSize` of
 *   the source in metres; `still`: without gestures and buttons.
 * @returns {{canvas: HTMLCanvasElement, draw: function(string): void, destroy: function(): void, over: object}} `draw` is given the colour around the picture;
 *   `over`: what may lie over the picture, as object/annotations.js uses it.
 */
export function mountZoomed(stage, source, state, { changed, pixelSize, still }) {
  const canvas = element("canvas", { class: "picture", tabindex: 0, role: "img", "aria-label": LABEL });
  const context = canvas.getContext("2d");
  const bar = element("p", { class: "scale-bar", hidden: true }, element("span"));
  const notes = element("div", { class: "notes" });
  const tools = element("p", { class: "actions view-tools" });
  let put = () => {}; // puts what lies over the picture where a function from it to CSS pixels says
  let around = "";
  let moves = false;

  function draw(colour = around) {
    around = colour;
    const { clientWidth: width, clientHeight: height } = canvas;
    if (width === 0 || height === 0) return;
    let ratio = globalThis.devicePixelRatio ?? 1;
    if (source.width < state.width) ratio = Math.min(ratio, (FINER * source.width) / (state.width * state.scale(width, height)));
    const size = [Math.round(width * ratio), Math.round(height * ratio)];
    if (canvas.width !== size[0] || canvas.height !== size[1]) [canvas.width, canvas.height] = size;
    const scale = state.scale(width, height) * ratio;
    context.fillStyle = around;
    context.fillRect(0, 0, ...size);
    context.imageSmoothingQuality = "high";
    context.drawImage(source, size[0] / 2 - state.centre[0] * scale, size[1] / 2 - state.centre[1] * scale, state.width * scale, state.height * scale);
    put((u, v) => [canvas.clientLeft + width / 2 + ((u - state.centre[0]) * scale) / ratio, canvas.clientTop + height / 2 + ((v - state.centre[1]) * scale) / ratio]);
    if (pixelSize !== null) showScale(bar, (1000 * pixelSize * ratio) / scale);
  }

  stage.append(element("div", { class: "framed" }, canvas, notes, bar));
  if (!still) {
    const { zoom } = listen(canvas, state, { moves: () => moves, changed });
    const button = (text, onclick, more = {}) => element("button", { type: "button", class: "quiet", onclick, ...more }, text);
    const drag = button("Drag the picture", () => {
      moves = !moves;
      drag.setAttribute("aria-pressed", String(moves));
      canvas.classList.toggle("moves", moves);
    }, { "aria-pressed": "false" });
    stage.append(tools);
    tools.append(drag, button("Zoom in", () => zoom(ZOOM)), button("Zoom out", () => zoom(1 / ZOOM)),
      button("Show all", () => changed({ zoom: 1, centre: [state.width / 2, state.height / 2] })),
      button("Full screen", () => (document.fullscreenElement === null ? stage.requestFullscreen() : document.exitFullscreen())));
  }
  const resized = new ResizeObserver(() => draw());
  resized.observe(canvas);
  const over = { notes, tools, width: state.width, height: state.height, show: changed,
    onplace: (each) => { put = each; draw(); },
    pixelOf: (x, y) => {
      const { left, top, width, height } = canvas.getBoundingClientRect();
      const scale = state.scale(canvas.clientWidth, canvas.clientHeight);
      return [state.centre[0] + (x - left - width / 2) / scale, state.centre[1] + (y - top - height / 2) / scale];
    } };
  return { canvas, draw, over, destroy: () => resized.disconnect() };
}
