/** The live view, where the camera has one: what it sees, how much of that clips, and how sharp it is. */

import { attempt, post } from "../api.js";
import { byId, show } from "../element.js";
import { showPicture } from "./picture.js";

/** Return a function that shows the live view of a state. */
export function mountLive() {
  let best = 0;
  let shown = 0;
  byId("live").addEventListener("click", ({ currentTarget }) => attempt(async () => {
    best = 0;
    shown = 0;
    await post("/set/look", { on: currentTarget.getAttribute("aria-pressed") === "false" });
  }));
  return ({ live, running }) => {
    byId("live").setAttribute("aria-pressed", String(live !== null));
    byId("live").disabled = running;
    show(byId("seen"), live !== null);
    if (live === null) return;
    if (live.number !== shown) {
      shown = live.number;
      showPicture(byId("seen-picture"), `/set/live?number=${shown}`);
    }
    best = Math.max(best, live.focus ?? 0);
    byId("seen-words").classList.toggle("fault", live.refused !== null);
    byId("seen-words").textContent = live.refused ?? (live.focus === null ? "The camera is being opened …"
      : `Focus ${live.focus.toFixed(3)}, the best was ${best.toFixed(3)} · ${(100 * live.clipped).toFixed(1)} % clipped · all lamps`);
  };
}
