/** The stage at this machine: captures are started, watched, and their pictures taken again. */

import { attempt, post, read } from "./api.js";
import { mountLamps } from "./dome.js";
import { byId, element, show } from "./element.js";

const PAUSE_MS = 250;
const MISSING = [0.08, 0.08, 0.08];
const THERE = [1, 1, 1];
const FAULTY = [1, 0.02, 0.02];

const rig = await read("/set/rig");
byId("rig").textContent = rig.name;
byId("plans").append(...rig.plans.map((name) => element("option", { value: name })));
const colour = mountLamps(byId("dome"), rig.lamps);

/** Start a capture with the values of the form. */
async function start(changes) {
  const form = byId("run");
  if (!form.reportValidity()) return;
  const then = byId("then").checked ? "solve,export" : "";
  await attempt(() => post("/set/run", { name: byId("name").value, plan: byId("plan").value, then, ...changes }));
}

byId("run").addEventListener("submit", (event) => {
  event.preventDefault();
  start({});
});
byId("meter").addEventListener("click", () => start({ preview: true, then: "" }));
byId("stop").addEventListener("click", () => attempt(() => post("/set/stop")));
byId("confirm").addEventListener("click", () => attempt(() => post("/set/confirm")));

for (const id of ["picture", "preview", "metered"]) byId(id).addEventListener("load", ({ target }) => { target.dataset.shown = target.src; });

/** Show the picture of a shot. */
function look(shot) {
  const picture = byId("picture");
  picture.src = `/set/picture?shot=${encodeURIComponent(shot)}&at=${Date.now()}`;
  picture.alt = shot;
  show(picture, true);
}

function wordsOf({ taken, faults, retaken }) {
  const state = !taken ? "missing" : faults.length ? faults.join("; ") : "good";
  return retaken ? `${state}, taken ${retaken + 1} times` : state;
}

function row(shot, running) {
  const name = shot.taken ? element("button", { type: "button", class: "quiet", onclick: () => look(shot.shot) }, shot.shot) : shot.shot;
  const again = shot.taken ? element("button", { type: "button", class: "quiet", disabled: running, "aria-label": `Take ${shot.shot} again`,
    onclick: () => start({ retake: shot.shot }) }, "Retake") : null;
  return element("tr", { "data-shot": shot.shot }, element("td", {}, name), element("td", {}, shot.lamp === null ? "" : rig.lamps[shot.lamp].name),
    element("td", { class: shot.taken && shot.faults.length ? "fault" : null }, wordsOf(shot)), element("td", {}, again));
}

function paint(state) {
  const there = state.shots.filter((shot) => shot.taken).length;
  const faulty = state.shots.filter((shot) => shot.taken && shot.faults.length).length;
  byId("state").textContent = state.code === null && !state.running ? "No capture has been started."
    : `${there} of ${state.shots.length} pictures, ${faulty} with a fault; ${state.running ? "running" : `ended${state.code ? ` with code ${state.code}` : ""}`}`;
  show(byId("please"), state.prompt !== null && state.running);
  byId("prompt").textContent = state.prompt ?? "";
  byId("lines").textContent = state.lines.join("\n");
  byId("stop").disabled = !state.running;
  byId("start").disabled = byId("meter").disabled = state.running;
  byId("shots").replaceChildren(...state.shots.map((shot) => row(shot, state.running)));
  const ofLamp = rig.lamps.map((_, index) => state.shots.find((shot) => shot.lamp === index));
  colour({ colours: ofLamp.map((shot) => (!shot?.taken ? MISSING : shot.faults.length ? FAULTY : THERE)), levels: [],
    words: ofLamp.map((shot) => (shot === undefined ? "not in the plan" : wordsOf(shot))) });
  for (const [id, name] of [["preview", "preview.png"], ["metered", "meter.png"]]) {
    const changed = state.files[name];
    show(byId(id), changed !== undefined);
    if (changed !== undefined && byId(id).dataset.changed !== String(changed)) {
      byId(id).src = `/set/files/${name}?at=${changed}`;
      byId(id).dataset.changed = String(changed);
    }
  }
}

let shown = "";
for (;;) {
  try {
    const state = await read("/set/state");
    const text = JSON.stringify(state);
    if (text !== shown) paint(state);
    const latest = state.shots.filter((shot) => shot.taken).at(-1);
    if (state.running && latest !== undefined && byId("picture").alt !== latest.shot) look(latest.shot);
    shown = text;
  } catch (error) {
    byId("state").textContent = error.message;
  }
  await new Promise((resolve) => setTimeout(resolve, PAUSE_MS));
}
