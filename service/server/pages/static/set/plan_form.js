/** The form of a capture: its name, its plan, and what is started with them. */

import { attempt, post } from "../api.js";
import { byId, element } from "../element.js";

const name = byId("name");
const plan = byId("plan");

/** Return the name of the capture, and the names of the sequences of its plan. */
export function planned() {
  return { name: name.value, sequences: plan.value.split(",").map((word) => word.trim()).filter(Boolean) };
}

/** Start a capture with the values of the form and some others. */
export async function start(changes = {}) {
  if (byId("run").reportValidity()) await attempt(() => post("/set/run", { name: name.value, plan: planned().sequences.join(","), ...changes }));
}

/** Show a capture that was taken before. */
export function open(capture) {
  return attempt(() => post("/set/open", { name: capture }));
}

/** Fill the form. */
export function fill(values) {
  name.value = values.name;
  plan.value = values.plan;
}

/** Take notice of the captures that there are, and of the one that is shown; a person's own words stay. */
export function follow(before, state) {
  byId("captures").replaceChildren(...state.captures.map((value) => element("option", { value })));
  if (state.name !== "" && (before === null || before.name !== state.name || before.plan !== state.plan)) fill(state);
}

/** Let the form work; `changed` is called when a person has changed it. */
export function mountForm(plans, changed) {
  byId("plans").append(...plans.map((value) => element("option", { value })));
  byId("run").addEventListener("submit", (event) => {
    event.preventDefault();
    start();
  });
  for (const each of [name, plan]) each.addEventListener("input", changed);
  name.addEventListener("change", () => [...byId("captures").options].some(({ value }) => value === name.value) && open(name.value));
  byId("meter").addEventListener("click", () => start({ preview: true }));
  byId("stop").addEventListener("click", () => attempt(() => post("/set/stop")));
  byId("confirm").addEventListener("click", () => attempt(() => post("/set/confirm")));
}
