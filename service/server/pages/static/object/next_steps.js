/** The buttons of what a capture is made for: one job each, with its defaults. */

import { attempt, submitJob } from "../api.js";
import { element, show } from "../element.js";
import { once } from "../once.js";

const MOST_STEPS = 2; // beside lighting it
const OPTIONS_OF_SOLVE = { pipeline: "solve", solve: "options" }; // where the request of a kind has the options of the solve
const FOUND = "Nobody has measured where the lights were: they are taken for distant ones, and found from the photographs.";

/** Return what the frames of a capture were lit by, or what a capture without frames holds. */
export function heldBy(facts) {
  return facts.lit_by ?? ["shots", "tiles"].filter((name) => name in facts);
}

/** Return the facts of a capture; where an earlier build has checked it, which did not note what lit its frames, with the light of its view. */
export function litFacts(facts, view) {
  return view.info.frames.some(({ direction }) => direction !== null) ? { lit_by: ["light"], ...facts } : facts;
}

/** Return whether the lights of a capture are placeholders; a capture that an earlier build has checked does not say so. */
export function hasUnknownLights({ lit_by: litBy = [], calibrated }) {
  return calibrated !== undefined && litBy.includes("light") && !calibrated.includes("lights");
}

/** Return the request of a step with its defaults, which find lights that nobody has measured from the images. */
export function requestOf(kind, capture, facts) {
  const part = OPTIONS_OF_SOLVE[kind];
  return { kind, capture, ...(part !== undefined && hasUnknownLights(facts) ? { [part]: { lights: "unknown" } } : {}) };
}

/**
 * Show the steps that apply to a capture, and what they take for granted.
 * @param {HTMLElement} box With a button for each step.
 * @param {string[]} done Kinds of jobs that need not be offered.
 * @param {function(any): any} submitted Is given the job of a step that was chosen.
 * @returns {string[]} The kinds of jobs that are offered.
 */
export function offerSteps(box, facts, identifier, done, submitted) {
  const all = [...box.querySelectorAll("[data-kind]")];
  const buttons = all.filter(({ dataset }) => heldBy(facts).includes(dataset.holds) && !done.includes(dataset.kind)).slice(0, MOST_STEPS);
  for (const button of all) {
    show(button, buttons.includes(button));
    button.onclick = () => attempt(() => once(button, async () => submitted(await submitJob(requestOf(button.dataset.kind, identifier, facts)))));
  }
  box.querySelector(".granted")?.remove();
  if (hasUnknownLights(facts) && buttons.some(({ dataset }) => dataset.kind in OPTIONS_OF_SOLVE)) box.append(element("small", { class: "granted" }, FOUND));
  return buttons.map(({ dataset }) => dataset.kind);
}

/** Let the first of the buttons in sight be the one that stands out. */
export function setPrimary(box) {
  const buttons = [...box.querySelectorAll("button, .button")].filter((each) => !each.hidden);
  buttons.forEach((each, at) => each.classList.toggle("quiet", at > 0));
}
