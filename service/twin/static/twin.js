/** The picture of the twin and the levels of its lamps, asked for as they change. */

import { mountLamps } from "/static/dome.js";

const PAUSE_MS = 50;
const ENDED_MS = 2000; // without an answer

async function json(address) {
  const answer = await fetch(address);
  if (!answer.ok) throw new Error(`${address}: ${answer.status}`);
  return answer.json();
}

const picture = document.getElementById("picture");
const words = document.getElementById("state");
const rig = await json("/rig.json");
document.getElementById("name").textContent = rig.name;
const colour = mountLamps(document.getElementById("dome"), rig.lamps);
let shown = -1;
let lostAt = null; // since when the twin does not answer
for (;;) {
  try {
    const state = await json("/state.json");
    if (state.frame !== shown || lostAt !== null) {
      picture.src = `/picture.png?frame=${state.frame}`;
      await picture.decode();
      colour(state);
      shown = state.frame;
      lostAt = null;
      words.textContent = shown === 0 ? "Waiting for the first frame …"
        : `${shown} frames received${state.out_of_order ? `, ${state.out_of_order} packets out of order` : ""}`;
    }
  } catch {
    lostAt ??= performance.now();
    words.textContent = performance.now() - lostAt < ENDED_MS ? "The twin does not answer …" : "The twin has ended.";
  }
  await new Promise((resolve) => setTimeout(resolve, PAUSE_MS));
}
