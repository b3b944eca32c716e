/** The page of a drive: the levels of the lamps, frame by frame, and the light that they give. */

import { attempt, read, resultsOf, save, send } from "./api.js";
import { mountLamps } from "./dome.js";
import { byId, element, show } from "./element.js";

const identifier = byId("main").dataset.identifier;
const FILES = ["cues.json", "cues.csv", "rig.json", "report.json"];

/** Return the direction from the subject to a lamp, as a unit vector. */
function directionOf(lamp, subject) {
  const towards = lamp.direction ?? lamp.position_m.map((part, axis) => part - subject[axis]);
  const length = Math.hypot(...towards);
  return towards.map((part) => part / length);
}

/** Return the levels of each lamp in a frame, and its light: the sum over its primaries. */
function lightOf(rig, frame) {
  let next = 0;
  const levels = rig.lights.map((lamp) => lamp.primaries.map(() => frame.levels[next++]));
  const light = rig.lights.map((lamp, index) => [0, 1, 2].map((channel) => lamp.primaries.reduce(
    (sum, primary, place) => sum + levels[index][place] * primary.irradiance[channel], 0)));
  return { levels, light };
}

function presentFrames(rig, cues) {
  const frames = cues.frames.map((frame) => lightOf(rig, frame));
  const most = frames.reduce((found, { light }) => light.reduce((greatest, colour) => Math.max(greatest, ...colour), found), 0) || 1;
  const subject = rig.subject_m ?? [0, 0, 0];
  const colour = mountLamps(byId("dome"), rig.lights.map((lamp) => ({ name: lamp.name, direction: directionOf(lamp, subject) })));
  const slider = byId("frame-number");
  slider.max = String(frames.length - 1);
  const present = () => {
    const { levels, light } = frames[Number(slider.value)];
    colour({ levels, colours: light.map((channels) => channels.map((value) => value / most)) });
    const brightest = levels.reduce((found, each) => each.reduce((greatest, level) => Math.max(greatest, level), found), 0);
    byId("frame").textContent = `${cues.frames[Number(slider.value)].frame}: the brightest primary is at ${(100 * brightest).toFixed(1)} %`;
  };
  slider.addEventListener("input", present);
  present();
}

await attempt(async () => {
  const job = await read(`/v1/jobs/${identifier}`);
  if (job.request.kind !== "drive" || job.state !== "succeeded") {
    byId("state").textContent = job.request.kind === "drive" ? `The job is ${job.state}: there are no cues yet.` : "This job drives no rig.";
    return;
  }
  const results = resultsOf(identifier);
  const [rig, cues, picture] = await Promise.all([results.json("rig.json"), results.json("cues.json"),
    send(`/v1/jobs/${identifier}/results/preview.png`).then((answer) => answer.blob())]);
  byId("name").textContent = `Drive of ${rig.name}`;
  document.title = `Drive of ${rig.name} · Relit`;
  byId("picture").src = URL.createObjectURL(picture);
  byId("files").replaceChildren(...FILES.map((name) => element("button", { type: "button", class: "quiet",
    onclick: () => attempt(() => save(`/v1/jobs/${identifier}/results/${name}`)) }, `Download ${name}`)));
  presentFrames(rig, cues);
  show(byId("view"), true);
});
