/** A preview of what a job would make, on the middle quarter of the pixels. */

import { attempt, submitJob } from "../api.js";
import { show } from "../element.js";
import { requestOf } from "../object/next_steps.js";
import { mountResults, PREVIEW, viewOf } from "../object/results.js";
import { followed } from "../view_jobs.js";

const MADE_BY = { pipeline: "solve", solve: "solve", depth: "depth" }; // what shows how a step will turn out
const LEAST_PX = 16; // of a side

/** Return the middle of an image, half as wide and half as high, whole pairs of pixels from its corner: x, y, width and height. */
function middleOf([width, height]) {
  const half = [width, height].map((side) => 2 * Math.floor(side / 4));
  return [...[width, height].map((side, axis) => 2 * Math.floor((side - half[axis]) / 4)), ...half];
}

/**
 * Offer the preview where a capture allows one.
 * @param {HTMLButtonElement} button
 * @param {HTMLElement} place Takes the preview.
 * @param {string} capture Identifier.
 * @param {{resolution?: number[], captures?: number}} facts Of the capture.
 * @param {string|undefined} step The kind of job that is offered first.
 */
export function offerPreview(button, place, capture, facts, step) {
  const { resolution, captures } = facts;
  const kind = MADE_BY[step];
  if (kind === undefined || captures !== 1 || resolution === undefined || Math.min(...resolution) < LEAST_PX) return;
  show(button, true);
  button.addEventListener("click", () => attempt(async () => {
    button.disabled = true;
    try {
      place.replaceChildren();
      const wanted = requestOf(kind, capture, facts);
      const job = await followed(await submitJob({ ...wanted, name: PREVIEW, options: { ...wanted.options, crop: middleOf(resolution) } }), place,
        "The middle of the frames is solved, a quarter of their pixels.", "the preview was not made");
      await mountResults(place, await viewOf(job.id, place));
    } finally {
      button.disabled = false;
    }
  }));
}
