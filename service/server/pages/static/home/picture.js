/** Pictures of cards: that of a capture, whose light follows the pointer, and that of an environment. The view job makes the first (docs/view.md). */

import { Refusal, resultsOf } from "../api.js";
import { element } from "../element.js";
import { loadEnvironment } from "../environments.js";

const GRID = 5; // pictures in each row and column of the sheet
const MOST_PIXELS = 1 << 20; // of an environment that is read for its card: larger ones would hold the page up

/**
 * Return the picture of a prepared capture; null: its view is older than such pictures.
 * @param {string} view Identifier of the job that has prepared it.
 */
export async function pictureOf(view) {
  const files = resultsOf(view);
  const picture = await bitmap(files, "card.jpg");
  if (picture === null) return null;
  const canvas = element("canvas", { width: picture.width, height: picture.height, "aria-hidden": "true" });
  const context = canvas.getContext("2d");
  const rest = () => context.drawImage(picture, 0, 0);
  let sheet; // a promise, from the first time that the pointer comes
  const follow = async (event) => {
    const { left, top, width, height } = canvas.getBoundingClientRect();
    const [u, v] = [(event.clientX - left) / width, (event.clientY - top) / height].map((share) => Math.min(Math.max(share, 0), 1));
    sheet ??= bitmap(files, "card_lights.jpg").catch(() => null);
    const loaded = await sheet;
    if (loaded !== null && canvas.closest(".card").matches(":hover")) blend(context, loaded, u, v);
  };
  return { canvas, mount: (card) => {
    rest();
    card.addEventListener("pointermove", follow);
    card.addEventListener("pointerleave", rest);
  } };
}

/** Return a small picture of an environment; null: it is large. */
export async function environmentPicture({ id, facts }) {
  const [width, height] = facts?.resolution ?? [0, 0];
  if (width * height === 0 || width * height > MOST_PIXELS) return null;
  const { previewOf, readEnvironment } = await import("../view/light/environment_map.js");
  const { name, data } = await loadEnvironment(id);
  const canvas = previewOf(await readEnvironment(data, name, "lin_rec709_scene"));
  canvas.className = "";
  canvas.setAttribute("aria-hidden", "true");
  return { canvas, mount: () => {} };
}

/** Draw the sum of the four pictures of the sheet around a place, 0 to 1 across and down. */
function blend(context, sheet, u, v) {
  const { width, height } = context.canvas;
  const [cellWidth, cellHeight] = [sheet.width / GRID, sheet.height / GRID];
  const [across, down] = [u, v].map((share) => Math.min(share * (GRID - 1), GRID - 1 - 1e-6));
  const [col, row] = [Math.floor(across), Math.floor(down)];
  context.globalCompositeOperation = "source-over";
  context.globalAlpha = 1;
  context.fillStyle = "black";
  context.fillRect(0, 0, width, height);
  context.globalCompositeOperation = "lighter";
  for (const [dx, dy] of [[0, 0], [1, 0], [0, 1], [1, 1]]) {
    context.globalAlpha = (dx === 0 ? 1 - across + col : across - col) * (dy === 0 ? 1 - down + row : down - row);
    context.drawImage(sheet, (col + dx) * cellWidth, (row + dy) * cellHeight, cellWidth, cellHeight, 0, 0, width, height);
  }
  context.globalCompositeOperation = "source-over";
  context.globalAlpha = 1;
}

async function bitmap(files, name) {
  try {
    return await createImageBitmap(new Blob([await files.bytes(name)], { type: "image/jpeg" }));
  } catch (error) {
    if (error instanceof Refusal && error.status === 404) return null;
    throw error;
  }
}
