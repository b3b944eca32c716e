/** The list of what belongs to a capture: what is there, what is planned, and what its absence means. */

import { attempt, post } from "../api.js";
import { byId, element, setChildren } from "../element.js";
import { LACKS } from "../pages/calibrations.js";
import { fill, open, planned, start } from "./plan_form.js";

const STEPS = [
  { id: "dark", name: "Dark", takes: ["dark"], lacks: LACKS.dark },
  { id: "flat", name: "White card", takes: ["flat"], lacks: LACKS.flat },
  { id: "ball", name: "Ball", takes: ["mirror-ball", "grey-ball"], alone: true, lacks: "The directions of the lights are those of the rig file.", use: "Measure the lights", used: "The lights are measured by it." },
  { id: "chart", name: "Colour chart", takes: ["chart"], alone: true, lacks: LACKS.colours, use: "Correct the colours", used: "The colours are corrected by it." },
];
const PROJECTOR = { id: "projector-response", name: "Projector", takes: ["projector-response"], lacks: "The projector is taken to give light in proportion to what it is sent." };
const OBJECT = { id: "object", name: "Object", takes: ["olat"], lacks: "There is nothing to solve." };

/** Return the sequences of a plan with a further one, in the order in which they are taken. */
function withStep(sequences, step) {
  const rank = (word) => ([...STEPS, PROJECTOR].findIndex(({ takes }) => takes.includes(word)) + 1) || STEPS.length + 2;
  return [...sequences, step.takes[0]].sort((one, other) => rank(one) - rank(other)).join(",");
}

/** Return the name of a capture that there is not yet: with the next number at its end. */
function following(name, captures) {
  const stem = name.replace(/-\d+$/, "");
  for (let number = 2; ; number += 1) if (!captures.includes(`${stem}-${number}`)) return `${stem}-${number}`;
}

/** Return the state of a step, and the words and the action of the button that changes it. */
function stateOf(step, state, changed) {
  const { name, sequences } = planned();
  const shots = state.name === name ? state.shots.filter((shot) => shot.step === step.id) : [];
  const there = shots.filter((shot) => shot.taken).length;
  const faulty = shots.filter((shot) => shot.taken && shot.faults.length).length;
  const begun = state.name === name && state.shots.some((shot) => shot.taken);
  const isPlanned = sequences.some((word) => step.takes.includes(word));
  const alone = `${name}-${step.id}`;
  const button = (words, action) => ({ words, action });
  const plan = (words, values) => button(words, () => { fill(values); changed(); });
  const usable = state.name === name && state.version !== null && step.id in state.calibrations;
  const done = usable && state.calibrations[step.id] ? ` ${step.used}` : "";
  const calibrating = usable && !done ? button(step.use, () => attempt(() => post("/set/calibrate", { step: step.id }))) : null;
  if (there > 0 || (begun && isPlanned)) {
    const words = `${there} of ${shots.length} ${shots.length === 1 ? "picture" : "pictures"}${faulty ? `, ${faulty} with a fault` : ""}.`;
    return { mark: faulty ? "wrong" : there === shots.length ? "there" : "", words: words + done, button: calibrating };
  }
  if (isPlanned) {
    return { mark: "", words: "In the plan.", button: sequences.length > 1 ? plan("Leave out", { name, plan: sequences.filter((word) => !step.takes.includes(word)).join(",") }) : null };
  }
  if (state.captures.includes(alone)) return { mark: "there", words: `There, as the capture ${alone}.${done}`, button: calibrating ?? button("Show", () => open(alone)) };
  if (!begun) return { mark: "", words: step.lacks, button: plan("Add", { name, plan: withStep(sequences, step) }) };
  return step.alone ? { mark: "", words: step.lacks, button: button("Take it now", () => start({ name: alone, plan: step.takes[0] })) }
    : { mark: "", words: step.lacks, button: plan("New capture with it", { name: following(name, state.captures), plan: withStep(sequences, step) }) };
}

/**
 * Return a function that shows the steps.
 * @param {string[]} patterns Names of the plans of patterns.
 * @param {function(): void} changed Called when the plan has been changed here.
 */
export function mountSteps(patterns, changed) {
  const list = [...STEPS, ...(patterns.length ? [PROJECTOR] : []), { ...OBJECT, takes: ["olat", "gradients", "polarised", ...patterns] }];
  const lines = new Map(list.map((step) => [step, element("li", { "data-step": step.id })]));
  byId("steps").replaceChildren(...lines.values());
  return (state) => {
    for (const [step, line] of lines) present(line, step, state, stateOf(step, state, changed));
  };
}

/** Show a step; its button stays as long as it does the same, and with it the focus and a click that has begun. */
function present(line, step, { running }, { mark, words, button }) {
  const before = line.querySelector("button");
  const stays = before !== null && before.textContent === button?.words;
  const shown = button === null || stays ? before : element("button", { type: "button", class: "quiet", "aria-label": `${step.name}: ${button.words}` }, button.words);
  if (button !== null) Object.assign(shown, { onclick: button.action, disabled: running });
  const isFocused = before !== null && before === document.activeElement;
  const sign = { there: "✓ ", wrong: "! ", "": "○ " }[mark];
  setChildren(line, [element("strong", {}, element("span", { class: `mark ${mark}`, "aria-hidden": "true" }, sign), step.name), ...(button === null ? [] : [shown]),
    element("p", { class: "help" }, words)]);
  if (isFocused && !stays) line.querySelector("button")?.focus();
}
