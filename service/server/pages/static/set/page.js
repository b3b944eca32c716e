/** The stage at this machine: captures are planned, taken, watched, mended, and made into assets. */

import { load, read } from "../api.js";
import { byId, show } from "../element.js";
import { mountLive } from "./live.js";
import { mountNext } from "./next_step.js";
import { mountOutcome } from "./outcome.js";
import { showPicture } from "./picture.js";
import { follow, mountForm } from "./plan_form.js";
import { mountShots } from "./shots.js";
import { mountSteps } from "./steps.js";

const PAUSE_MS = 250;

/** Show the stage of a rig; return what shows its state anew. */
function mount(rig) {
  byId("rig").textContent = rig.name;
  document.title = `Set: ${rig.name} · Relit`;
  show(byId("live"), rig.live);
  let state = null;
  let shown = "";
  mountForm(rig, paint);
  const showSteps = mountSteps(rig.patterns, paint);
  const showShots = mountShots(rig.lamps);
  const showLive = mountLive();
  const showNext = mountNext();
  const results = mountOutcome(rig.patterns, () => state !== null && showNext(state, results.outcome));

  function paint() {
    if (state === null) return;
    showShots(state);
    showSteps(state);
    showMeter(state);
    byId("lines").textContent = state.lines.join("\n");
    results.follow(state);
    showNext(state, results.outcome);
  }

  return async () => {
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
  };
}

/** Show the metered pictures. */
function showMeter({ name, files }) {
  const changed = files["meter.png"];
  const metered = byId("metered");
  show(byId("metering"), changed !== undefined);
  if (changed === undefined || metered.dataset.changed === `${name} ${changed}`) return;
  showPicture(metered, `/set/files/meter.png?at=${changed}`);
  metered.dataset.changed = `${name} ${changed}`;
}

const look = await load(async () => { // until the state is here nothing can be typed that it would overwrite
  const first = mount(await read("/set/rig"));
  await first();
  return first;
});
while (look !== undefined) {
  await new Promise((resolve) => { setTimeout(resolve, PAUSE_MS); });
  await look();
}
