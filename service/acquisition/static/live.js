// Shows what the camera sees until the live view ends, how sharp that is, and how much of it clips.

const picture = document.querySelector("img");
const words = document.querySelector("p");
let best = 0;
let shown = 0;

async function refresh() {
  const live = await (await fetch("/state.json")).json();
  if (live.number !== shown) {
    shown = live.number;
    picture.src = `/live.png?number=${shown}`;
    await picture.decode();
  }
  best = Math.max(best, live.focus ?? 0);
  if (live.refused !== null) words.textContent = live.refused;
  else if (live.focus !== null) {
    words.textContent = `Focus ${live.focus.toFixed(3)}, the best was ${best.toFixed(3)} · ${(100 * live.clipped).toFixed(1)} % clipped · all lamps`;
  }
}

for (;;) {
  try {
    await refresh();
  } catch {
    words.textContent = "The live view has ended: the light is being metered, or the command was ended.";
  }
  await new Promise((done) => setTimeout(done, 200));
}
