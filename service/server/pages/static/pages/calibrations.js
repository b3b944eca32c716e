/** What a capture was calibrated with, and what is missing, as a list that leads to the forms. */

import { element } from "../element.js";

/** What it means that a calibration is missing. */
export const LACKS = {
  dark: "What the camera reads in the dark stays in the pictures.",
  flat: "What lens and lamps darken towards the edges stays in the pictures.",
  lights: "Nobody has measured where the lights are, which normals are solved from.",
  colours: "The colours are those of the camera.",
};
const STEPS = [
  { name: "dark", title: "Dark frame", kinds: ["calibrate-dark"] },
  { name: "flat", title: "White card", kinds: ["calibrate-flat-field"] },
  { name: "lights", title: "Lights", kinds: ["calibrate-mirror-ball", "calibrate-light-positions"], of: "light" },
  { name: "colours", title: "Colours", kinds: ["calibrate-chart", "calibrate-white-balance"] },
];

/** Open the form of a kind of job, and go to it. */
function open(form) {
  for (let at = form.parentElement; at !== null; at = at.parentElement) if (at.tagName === "DETAILS") at.open = true;
  form.scrollIntoView({ block: "start" });
  form.querySelector("input, select, textarea").focus();
}

/**
 * Return the list.
 * @param {{calibrated?: string[], lit_by?: string[]}} facts Of the capture; without `calibrated` an earlier build has checked it, and there is no list.
 * @param {HTMLElement} forms With the forms of the calibrations that apply.
 * @returns {HTMLElement|null} null: nothing is known, or nothing applies.
 */
export function calibrationList({ calibrated, lit_by: litBy = [] }, forms) {
  if (calibrated === undefined) return null;
  const items = STEPS.filter(({ of }) => of === undefined || litBy.includes(of)).map(({ name, title, kinds }) => {
    const found = kinds.map((kind) => forms.querySelector(`form[data-kind=${kind}]`)).filter((form) => form !== null);
    if (found.length === 0) return null;
    const isThere = calibrated.includes(name);
    const buttons = found.map((form) => element("button", { type: "button", class: "quiet", onclick: () => open(form) }, form.closest(".job-form").querySelector("summary").textContent));
    return element("li", { class: isThere ? "there" : "missing", "data-calibration": name }, element("strong", {}, title), isThere ? " The capture has it." : ` ${LACKS[name]}`,
      isThere ? null : element("p", { class: "actions" }, ...buttons));
  }).filter((item) => item !== null);
  return items.length === 0 ? null : element("ul", { class: "calibrations plain" }, ...items);
}
