/** The photographs of a capture: a thumbnail of each, and its light on the dome. */

import { mountDome } from "../dome.js";
import { byId, element, show } from "../element.js";

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
  const lit = view.info.relight === null ? [] : frames.filter(({ direction }) => direction !== null);
  const figures = frames.map((frame, index) => figure(frame, index, atlas, lit.indexOf(frame)));
  parent.replaceChildren(...figures);
  let mark = () => {};
  const choose = (index) => {
    figures.forEach((each, at) => each.classList.toggle("chosen", at === index));
    figures[index].scrollIntoView({ block: "nearest", inline: "nearest" });
    mark(index);
  };
  show(dome, frames.some((frame) => frame.direction !== null));
  if (!dome.hidden) mark = mountDome(dome, frames, choose);
}

/** Return a photograph; where it can be compared with live light, as the `at`th, its name leads to it there, whole and under its own light. */
function figure(frame, index, atlas, at) {
  const [x, y, width, height] = frame.thumbnail ?? [0, 0, 96, 96];
  const canvas = element("canvas", { width, height, role: "img", "aria-label": `Frame ${index + 1}: ${frame.image}` });
  if (frame.thumbnail !== null) canvas.getContext("2d").drawImage(atlas, x, y, width, height, 0, 0, width, height);
  const clipped = frame.saturated === null ? "cannot be read" : frame.saturated > CLIPPED_SHARE ? `${(100 * frame.saturated).toFixed(1)} % clipped` : null;
  return element("figure", { class: frame.suspect === null ? "" : "suspect" }, canvas,
    element("figcaption", {}, at < 0 ? frame.image : element("a", { href: `/light/${byId("main").dataset.identifier}#compare=${at}&wipe=0&light=${frame.direction.map((part) => part.toFixed(3))}` }, frame.image), element("small", {}, [frame.label, clipped, frame.suspect].filter(Boolean).join(" · "))));
}
