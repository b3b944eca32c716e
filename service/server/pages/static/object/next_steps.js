/** The buttons of what a capture is made for: one job each, with its defaults. */

import { attempt, submitJob } from "../api.js";
import { show } from "../element.js";

const MOST_STEPS = 2; // beside lighting it

/** Return what the frames of a capture were lit by, or what a capture without frames holds. */
export function heldBy(facts) {
  return facts.lit_by ?? ["shots", "tiles"].filter((name) => name in facts);
}

/** Return the facts of a capture; where an earlier build has checked it, which did not note what lit its frames, with the light of its view. */
export function litFacts(facts, view) {
  return view.info.frames.some(({ direction }) => direction !== null) ? { lit_by: ["light"], ...facts } : facts;
}

/**
 * Show the steps that apply to a capture.
 * @param {HTMLElement} box With a button for each step.
 * @param {string[]} done Kinds of jobs that need not be offered.
 * @returns {string[]} The kinds of jobs that are offered.
 */
export function offerSteps(box, facts, identifier, done = []) {
  const buttons = [...box.querySelectorAll("[data-kind]")].filter(({ dataset }) => heldBy(facts).includes(dataset.holds) && !done.includes(dataset.kind)).slice(0, MOST_STEPS);
  for (const button of buttons) {
    show(button, true);
    button.addEventListener("click", () => attempt(async () => {
      button.disabled = true;
      const job = await submitJob({ kind: button.dataset.kind, capture: identifier }).finally(() => { button.disabled = false; });
      location.assign(`/jobs/${job.id}`);
    }));
  }
  return buttons.map(({ dataset }) => dataset.kind);
}
