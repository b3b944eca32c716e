/** The page of a drive: the levels of the lamps, frame by frame, and the light that they give. */

import { attempt, fetched, listing, load, read, resultsOf, save } from "../api.js";
import { mountLamps } from "../dome.js";
import { mountBalls, mountEnvironment, mountObject } from "./drive_preview.js";
import { byId, element, show } from "../element.js";
import { loadEnvironment } from "../environments.js";
import { DISPLAY_SPACE } from "../view/colour_spaces.js";
import { ViewFile } from "../view/view_file.js";
import { openView } from "../view_jobs.js";

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

function presentFrames(rig, cues, views) {
  const frames = cues.frames.map((frame) => lightOf(rig, frame));
  const most = frames.reduce((found, { light }) => light.reduce((greatest, colour) => Math.max(greatest, ...colour), found), 0) || 1;
  const subject = rig.subject_m ?? [0, 0, 0];
  const directions = rig.lights.map((lamp) => directionOf(lamp, subject));
  const colour = mountLamps(byId("dome"), rig.lights.map((lamp, index) => ({ name: lamp.name, direction: directions[index] })));
  const slider = byId("frame-number");
  slider.max = String(frames.length - 1);
  const present = () => {
    const place = Number(slider.value);
    const { levels, light } = frames[place];
    colour({ levels, colours: light.map((channels) => channels.map((value) => value / most)) });
    for (const view of views) view(place);
    const brightest = levels.reduce((found, each) => each.reduce((greatest, level) => Math.max(greatest, level), found), 0);
    byId("frame").textContent = `${cues.frames[place].frame}: the brightest primary is at ${(100 * brightest).toFixed(1)} %`;
  };
  slider.addEventListener("input", present);
  const light = frames.map((frame) => frame.light);
  views.push(mountBalls(byId("balls"), directions, light, rig.color_space ?? DISPLAY_SPACE));
  present();
  return { present, directions, light };
}

/** Offer the captures of the project as objects, with that of the job chosen. */
async function offerObjects(chosen, use) {
  const select = byId("object");
  const found = [];
  for await (const capture of listing("/v1/captures", "items")) if (capture.state === "ready") found.push(capture);
  select.append(...found.map(({ id, name }) => element("option", { value: id }, name)));
  select.addEventListener("change", () => attempt(() => use(select.value)));
  if (chosen !== undefined && found.some(({ id }) => id === chosen)) {
    select.value = chosen;
    await use(chosen);
  }
}

await load(async () => {
  const job = await read(`/v1/jobs/${identifier}`);
  if (job.request.kind !== "drive" || job.state !== "succeeded") {
    byId("state").textContent = job.request.kind === "drive" ? `The job is ${job.state}: there are no cues yet.` : "This job drives no rig.";
    return;
  }
  const results = resultsOf(identifier);
  const [rig, cues, picture] = await Promise.all([results.json("rig.json"), results.json("cues.json"),
    fetched(`/v1/jobs/${identifier}/results/preview.png`, (answer) => answer.blob())]);
  byId("name").textContent = `Drive of ${rig.name}`;
  document.title = `Drive of ${rig.name} · Relit`;
  byId("picture").src = URL.createObjectURL(picture);
  byId("files").replaceChildren(...FILES.map((name) => element("button", { type: "button", class: "quiet",
    onclick: () => attempt(() => save(`/v1/jobs/${identifier}/results/${name}`)) }, `Download ${name}`)));
  const views = [];
  const { present, directions, light } = presentFrames(rig, cues, views);
  show(byId("view"), true);
  const { environment, keys = null, options = {} } = job.request;
  if (environment !== undefined && environment !== null && keys === null) { // keys may turn it otherwise
    views.push(await mountEnvironment(byId("environment"), await loadEnvironment(environment), (options.spin_degrees ?? 0) / cues.frames.length));
    present();
  }
  let object = null;
  await offerObjects(job.request.capture ?? undefined, async (capture) => {
    if (object !== null) views.splice(views.indexOf(object), 1);
    object = null;
    byId("picture-of-object").replaceChildren();
    if (capture === "") return;
    const { files } = await openView(capture, null, null, byId("picture-of-object"));
    const mounted = element("div");
    const made = await mountObject(mounted, await ViewFile.open(files), directions, light, rig.color_space ?? DISPLAY_SPACE);
    if (byId("object").value !== capture) return; // another was chosen meanwhile
    byId("picture-of-object").replaceChildren(mounted);
    object = made;
    views.push(object);
    present();
  });
});
