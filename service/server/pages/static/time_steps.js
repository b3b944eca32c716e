/** The time steps of a sequence of captures, of which a page shows one: the address says which (`?step=3`). */

import { byId, element, show } from "./element.js";

/**
 * Return the number of the time step that is shown, from 1, and let the person choose another; null: the capture is no sequence.
 * @param {any} facts Of the capture; null: none are known.
 * @param {function(): Promise<string[]>} namesOf Gives the names of the steps, where they are known; asked for a sequence alone.
 */
export async function chosenStep(facts, namesOf = async () => []) {
  const count = facts?.steps ?? (facts?.captures > 1 ? facts.captures : 0);
  if (count === 0) return null;
  const names = await namesOf();
  const asked = Number(new URLSearchParams(location.search).get("step") ?? 1);
  const step = Number.isInteger(asked) && asked >= 1 && asked <= count ? asked : 1;
  const go = (to) => location.assign(`?step=${to}${location.hash}`);
  const options = Array.from({ length: count }, (_, index) => element("option", { value: index + 1, selected: index + 1 === step },
    names[index] === undefined ? `${index + 1} of ${count}` : `${names[index]} (${index + 1} of ${count})`));
  const select = element("select", { id: "time-step", onchange: () => go(select.value) }, ...options);
  byId("steps").replaceChildren(element("label", { for: "time-step" }, "Time step "), select,
    element("button", { type: "button", class: "quiet", disabled: step === 1, onclick: () => go(step - 1) }, "Step before"),
    element("button", { type: "button", class: "quiet", disabled: step === count, onclick: () => go(step + 1) }, "Step after"));
  show(byId("steps"), true);
  return step;
}
