/** The form of a capture: its name, its plan, and what is started with them. */

import { attempt, post } from "../api.js";
import { byId, element, show } from "../element.js";
import { once } from "../once.js";

const name = byId("name");
const plan = byId("plan");
const exposures = byId("exposures");
const tracking = byId("tracking");
const lights = byId("lights");
const edited = new Set(); // fields that a person has changed since the server was asked for something: what it tells leaves them alone
let lamps = [];
let notify = () => {};

const words = (field) => field.value.split(",").map((word) => word.trim()).filter(Boolean);

/** Return the name of the capture, and the names of the sequences of its plan. */
export function planned() {
  return { name: name.value, sequences: words(plan) };
}

/** Return the indices of the lamps that are lit one by one, of numbers and ranges such as 1-12, 20; null: all, undefined: the text is wrong. */
export function chosenLamps() {
  const found = [];
  for (const word of words(lights)) {
    const [, first, last] = /^(\d+)(?:\s*-\s*(\d+))?$/.exec(word) ?? [];
    const [from, to] = [Number(first), Number(last ?? first)];
    if (!(from >= 1 && from <= to && to <= lamps.length)) return undefined;
    for (let number = from; number <= to; number += 1) if (!found.includes(number - 1)) found.push(number - 1);
  }
  return found.length ? found : null;
}

/** Take a lamp among those that are lit one by one, or leave it out. */
export function toggleLamp(index) {
  const chosen = chosenLamps() ?? [];
  lights.value = rangesOf(chosen.includes(index) ? chosen.filter((each) => each !== index) : [...chosen, index]);
  edited.add(lights);
  notify();
}

/** Return the numbers of lamps as ranges. */
function rangesOf(indices) {
  const runs = [];
  for (const index of [...indices].sort((one, other) => one - other)) {
    if (runs.at(-1)?.[1] === index - 1) runs.at(-1)[1] = index;
    else runs.push([index, index]);
  }
  return runs.map(([first, last]) => (first === last ? `${first + 1}` : `${first + 1}-${last + 1}`)).join(", ");
}

/** Start a capture with the values of the form and some others. */
export async function start(changes = {}) {
  const times = words(exposures).map(Number);
  const chosen = chosenLamps();
  const decimal = /^\s*\d+,\d+\s*$/.exec(exposures.value); // a decimal comma, or two whole times
  exposures.setCustomValidity(decimal ? `Write ${decimal[0].trim().replace(",", ".")} for one time, or ${decimal[0].trim().replace(",", ", ")} for two.`
    : times.every((time) => time > 0) ? "" : "Give seconds, such as 0.05, 0.2.");
  lights.setCustomValidity(chosen === undefined ? `Give numbers from 1 to ${lamps.length}, such as 1-12, 20.` : "");
  if ([exposures, lights, tracking].some((field) => !field.validity.valid)) byId("more").open = true;
  if (!byId("run").reportValidity()) return;
  const choices = { plan: planned().sequences.join(","), exposures_s: times, tracking_every: tracking.value ? Number(tracking.value) : null,
    lights: chosen && chosen.map((index) => lamps[index].name) };
  await attempt(() => once(start, () => ask("run", { name: name.value, ...choices, ...changes })));
}

/** Ask the server for something; the form is then as it tells, but for what is changed from now on. */
function ask(what, values) {
  edited.clear();
  return post(`/set/${what}`, values);
}

/** Show a capture that was taken before. */
export function open(capture) {
  return attempt(() => ask("open", { name: capture }));
}

/** Fill in a name and the names of sequences for a person. */
export function fill(values) {
  name.value = values.name;
  plan.value = values.plan;
  edited.add(name).add(plan);
}

/** Take notice of the captures that there are, and of the one that is shown; a person's own words stay. */
export function follow(before, state) {
  byId("captures").replaceChildren(...state.captures.map((value) => element("option", { value })));
  const { chosen } = state;
  if (state.name === "" || (before !== null && before.name === state.name && JSON.stringify(before.chosen) === JSON.stringify(chosen))) return;
  const told = [[name, state.name], [plan, chosen.plan], [exposures, chosen.exposures_s.join(", ")], [tracking, chosen.tracking_every ?? ""],
    [lights, rangesOf((chosen.lights ?? []).map((light) => lamps.findIndex((lamp) => lamp.name === light)))]];
  for (const [field, value] of told) if (!edited.has(field)) field.value = value;
  if (chosen.exposures_s.length || chosen.tracking_every !== null || chosen.lights !== null) byId("more").open = true;
}

/** Let the form work for the lamps of a rig; `changed` is called when a person has changed it. */
export function mountForm(rig, changed) {
  lamps = rig.lamps;
  notify = changed;
  byId("plans").append(...rig.plans.map((value) => element("option", { value })));
  byId("run").addEventListener("submit", (event) => {
    event.preventDefault();
    start();
  });
  for (const each of [name, plan, exposures, tracking, lights]) each.addEventListener("input", () => edited.add(each));
  for (const each of [name, plan]) each.addEventListener("input", changed);
  for (const each of [exposures, lights]) each.addEventListener("input", () => each.setCustomValidity(""));
  lights.addEventListener("input", changed);
  name.addEventListener("change", () => [...byId("captures").options].some(({ value }) => value === name.value) && open(name.value));
  byId("meter").addEventListener("click", () => start({ preview: true }));
  byId("stop").addEventListener("click", () => attempt(() => post("/set/stop")));
  byId("confirm").addEventListener("click", () => attempt(async () => {
    show(byId("please"), false); // a second click would be an answer to the next question
    await post("/set/confirm").catch((error) => { show(byId("please"), true); throw error; });
  }));
}
