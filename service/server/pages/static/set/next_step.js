/** What a person does next: a sentence, and the button that does it stands out. */

import { byId, show } from "../element.js";
import { planned, start } from "./plan_form.js";

const BUTTONS = ["meter", "start", "mend", "stop", "solve", "export", "asset"];
const REFUSED = 2; // the exit code of a command that could not begin

/** Let the button work that takes all pictures with a fault again. */
export function mountNext() {
  let faulty = [];
  byId("mend").addEventListener("click", () => start({ retake: faulty }));
  return (state, outcome) => {
    faulty = state.shots.filter((shot) => shot.taken && shot.faults.length).map(({ shot }) => shot);
    const { words, offered, prominent } = nextOf(state, outcome, faulty.length);
    if (byId("now").textContent !== words) byId("now").textContent = words;
    for (const id of BUTTONS) {
      show(byId(id), offered.includes(id));
      byId(id).classList.toggle("quiet", id !== prominent);
    }
    byId("start").textContent = offered.includes("start") && begun(state) ? "Take the missing pictures" : "Take the capture";
    byId("solve").disabled = outcome.busy || outcome.solved;
    byId("export").disabled = outcome.busy;
    const problem = state.code === REFUSED ? state.lines.at(-1) ?? null : null;
    show(byId("problem"), problem !== null);
    if (problem !== null && byId("problem").textContent !== problem) byId("problem").textContent = problem;
    show(byId("please"), state.prompt !== null && state.running);
    if (byId("prompt").textContent !== (state.prompt ?? "")) byId("prompt").textContent = state.prompt ?? "";
    show(byId("projector"), state.projector !== null);
    byId("projector-page").href = byId("projector-page").textContent = state.projector ?? "";
  };
}

function begun(state) {
  return state.name === planned().name && state.shots.some((shot) => shot.taken);
}

function nextOf(state, outcome, faulty) {
  const total = state.shots.length;
  const there = state.shots.filter((shot) => shot.taken).length;
  if (state.running) {
    const words = state.prompt !== null ? "A person is asked to do something." : state.metering ? "Metering the light …" : state.calibrating !== null ? "Measuring …" : `Taking the pictures: ${there} of ${total} …`;
    return { words, offered: ["stop"], prominent: state.prompt === null ? "stop" : null };
  }
  if (!begun(state)) {
    const metered = state.name === planned().name ? state.lines.find((line) => line.startsWith("exposure")) : undefined;
    const words = metered === undefined ? "Meter the light, or take the capture." : `Set the exposure, then take the capture. The meter proposes: ${metered.replace(/^exposure\s*/, "")}`;
    return { words, offered: ["meter", "start"], prominent: "start" };
  }
  const count = `${there} of ${total} pictures, ${faulty} with a fault.`;
  if (there < total) return { words: `${count} Take those that are missing.`, offered: ["start"], prominent: "start" };
  if (outcome.asset !== null) return { words: `${count} The asset is made.`, offered: ["asset"], prominent: "asset" };
  const results = !outcome.solvable ? [] : outcome.patterns ? ["solve"] : ["solve", "export"]; // a rig has no calibrated projector
  if (faulty > 0) return { words: `${count} Take those with a fault again${outcome.solvable ? ", or go on as it is" : ""}.`, offered: ["mend", ...results], prominent: "mend" };
  if (!state.shots.some(({ step }) => step === "object")) return { words: `${count} Go on with the capture of the object: give its name.`, offered: [], prominent: null };
  if (!outcome.solvable) return { words: count, offered: [], prominent: null };
  if (outcome.patterns) return { words: `${count} ${outcome.solved ? "The patterns are decoded." : "Decode the patterns."}`, offered: results, prominent: "solve" };
  return { words: outcome.busy ? `${count} It is being solved.` : `${count} Make an asset of it.`, offered: results, prominent: "export" };
}
