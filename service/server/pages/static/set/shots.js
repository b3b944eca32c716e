/** The pictures of a capture as they come: in a table, on the dome of the lamps, and the one that is chosen. */

import { mountLamps } from "../dome.js";
import { byId, element, setChildren, show } from "../element.js";
import { showPicture } from "./picture.js";
import { chosenLamps, start, toggleLamp } from "./plan_form.js";

const MISSING = [0.08, 0.08, 0.08];
const THERE = [1, 1, 1];
const FAULTY = [1, 0.02, 0.02];
const CHOSEN = [0.1, 0.3, 1];

/** Show the picture of a shot. */
function look(shot) {
  const picture = byId("picture");
  showPicture(picture, `/set/picture?shot=${encodeURIComponent(shot)}&at=${Date.now()}`);
  picture.alt = shot;
  byId("shown-words").textContent = shot;
  show(byId("shown"), true);
}

function wordsOf({ taken, faults, retaken }) {
  const state = !taken ? "missing" : faults.length ? faults.join("; ") : "good";
  return retaken ? `${state}, taken ${retaken + 1} times` : state;
}

function row(shot, lamps, running) {
  const name = shot.taken ? element("button", { type: "button", class: "quiet", onclick: () => look(shot.shot) }, shot.shot) : shot.shot;
  const again = shot.taken ? element("button", { type: "button", class: "quiet", disabled: running, "aria-label": `Retake ${shot.shot}`,
    onclick: () => start({ retake: [shot.shot] }) }, "Retake") : null;
  return element("tr", { "data-shot": shot.shot }, element("td", {}, name), element("td", {}, shot.lamp === null ? "" : lamps[shot.lamp].name),
    element("td", { class: shot.taken && shot.faults.length ? "fault" : null }, wordsOf(shot)), element("td", {}, again));
}

/** Return a function that shows the pictures; rows that have not changed stay, and with them the focus of the keyboard. */
export function mountShots(lamps) {
  const colour = mountLamps(byId("dome"), lamps, toggleLamp);
  const body = byId("shots");
  let followed = null; // the picture that was shown because it was the last one
  return (state) => {
    const rows = new Map([...body.rows].map((each) => [each.dataset.shot, each]));
    setChildren(body, state.shots.map((shot) => {
      const text = JSON.stringify([shot, state.name, state.running]);
      const before = rows.get(shot.shot);
      if (before?.dataset.text === text) return before;
      const made = row(shot, lamps, state.running);
      made.dataset.text = text;
      return made;
    }));
    const ofLamp = lamps.map((_, index) => state.shots.find((shot) => shot.lamp === index && shot.step === "object") ?? state.shots.find((shot) => shot.lamp === index));
    const chosen = chosenLamps() ?? [];
    colour({ colours: ofLamp.map((shot, index) => (!shot?.taken ? chosen.includes(index) ? CHOSEN : MISSING : shot.faults.length ? FAULTY : THERE)), levels: [],
      words: ofLamp.map((shot) => (shot === undefined ? "not in the plan" : wordsOf(shot))) });
    const taken = state.shots.filter((shot) => shot.taken);
    const shown = byId("picture").alt;
    if (!taken.some(({ shot }) => shot === shown)) show(byId("shown"), false);
    const latest = taken.at(-1)?.shot;
    if (latest !== undefined && followed !== `${state.name} ${latest}` && (state.running || byId("shown").hidden)) {
      followed = `${state.name} ${latest}`;
      look(latest);
    }
  };
}
