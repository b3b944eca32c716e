/** The photographs of a capture: a thumbnail of each, and its light on the dome. */

import { mountDome } from "../dome.js";
import { element } from "../element.js";

const CLIPPED_SHARE = 0.0005; // of the pixels, from which it is said

/**
 * Show the photographs of a view.
 * @param {HTMLElement} parent Takes the thumbnails.
 * @param {HTMLElement} dome Takes the diagram of the lights.
 * @param {import("../view/view_file.js").ViewFile} view
 */
export async function mountPhotographs(parent, dome, view) {
  const { frames } = view.info;
  const atlas = await view.thumbnails();
  const figures = frames.map((frame, index) => figure(frame, index, atlas));
  parent.replaceChildren(...figures);
  let mark = () => {};
  const choose = (index) => {
    figures.forEach((each, at) => each.classList.toggle("chosen", at === index));
    figures[index].scrollIntoView({ block: "nearest", inline: "nearest" });
    mark(index);
  };
  if (frames.some((frame) => frame.direction !== null)) mark = mountDome(dome, frames, choose);
}

function figure(frame, index, atlas) {
  const [x, y, width, height] = frame.thumbnail ?? [0, 0, 96, 96];
  const canvas = element("canvas", { width, height, role: "img", "aria-label": `Frame ${index + 1}: ${frame.image}` });
  if (frame.thumbnail !== null) canvas.getContext("2d").drawImage(atlas, x, y, width, height, 0, 0, width, height);
  const clipped = frame.saturated === null ? "cannot be read" : frame.saturated > CLIPPED_SHARE ? `${(100 * frame.saturated).toFixed(1)} % clipped` : null;
  return element("figure", { class: frame.suspect === null ? "" : "suspect" }, canvas,
    element("figcaption", {}, frame.image, element("small", {}, [frame.label, clipped, frame.suspect].filter(Boolean).join(" · "))));
}
