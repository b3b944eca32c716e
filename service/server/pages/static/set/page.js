/** The stage at this machine: captures are planned, taken, watched, mended, and made into assets. */

import { read } from "../api.js";
import { byId, show } from "../element.js";
import { mountLive } from "./live.js";
import { mountNext } from "./next_step.js";
import { mountOutcome } from "./outcome.js";
import { showPicture } from "./picture.js";
import { follow, mountForm } from "./plan_form.js";
import { mountShots } from "./shots.js";
import { mountSteps } from "./steps.js";

const PAUSE_MS = 250;

const rig = await read("/set/rig");
byId("rig").textContent = rig.name;
document.title = `Set: ${rig.name} · Relit`;
show(byId("live"), rig.live);
let state = null;
mountForm(rig, paint);
const showSteps = mountSteps(rig.patterns, paint);
const showShots = mountShots(rig.lamps);
const showLive = mountLive();
const showNext = mountNext();
const results = mountOutcome(rig.patterns, () => state !== null && showNext(state, results.outcome));

/** Show the metered pictures. */
function showMeter({ name, files }) {
  const changed = files["meter.png"];
  const metered = byId("metered");
  show(byId("metering"), changed !== undefined);
  if (changed === undefined || metered.dataset.changed === `${name} ${changed}`) return;
  showPicture(metered, `/set/files/meter.png?at=${changed}`);
  metered.dataset.changed = `${name} ${changed}`;
}

function paint() {
  if (state === null) return;
  showShots(state);
  showSteps(state);
  showMeter(state);
  byId("lines").textContent = state.lines.join("\n");
  results.follow(state);
  showNext(state, results.outcome);
}

let shown = "";
for (;;) {
  try {
    const { live, ...now } = await read("/set/state");
    const text = JSON.stringify(now);
    if (text !== shown) {
      follow(state, now);
      state = now;
      paint();
    }
    showLive({ live, running: now.running });
    shown = text;
  } catch (error) {
    byId("now").textContent = error.message;
  }
  await new Promise((resolve) => { setTimeout(resolve, PAUSE_MS); });
}
