/** The modes of an object: what there is to show of it, and how each is shown. */

import { attempt } from "../api.js";
import { element, kindTitle } from "../element.js";
import { mountAsset } from "./asset.js";
import { mountFrames } from "./frames.js";
import { mountLight } from "./light.js";
import { hasUnknownLights } from "./next_steps.js";
import { mountPhotographs } from "./photographs.js";
import { mountResults, viewOf, warningsOf } from "./results.js";

const MAPS = ["solve", "pipeline", "join"]; // kinds of jobs that make maps

/**
 * Return the modes that an object has, by name: what each is called, how it is mounted, and the job that it shows, if one.
 * @param {string} identifier Of the capture. @param {import("../view/view_file.js").ViewFile} view Of it. @param {number|null} step Of a sequence.
 * @param {any[]} jobs Of the object, the newest first.
 * @param {any} facts Of the capture.
 * @param {any[]} environments Of the server.
 */
export function modesOf(identifier, view, step, jobs, facts, environments) {
  const of = (kinds) => jobs.filter((job) => kinds.includes(job.request.kind));
  const [solved, measured, exported] = [of(MAPS), of(["depth"]), of(["export", "pipeline"])];
  const relit = jobs.filter(({ request: { kind, environment, keys } }) => kind === "relight" || (kind === "pipeline" && Boolean(environment ?? keys)));
  const modes = {};
  const ofJob = (title, [job], mount) => (job === undefined ? undefined : { title, job: job.id, mount });
  const maps = (job) => async (parent) => mountResults(parent, await viewOf(job.id, parent));
  if (view.info.relight !== null && step === null) modes.light = { title: "Light", mount: (parent) => mountLight(parent, identifier, view, environments) };
  else if (hasUnknownLights(facts) && step === null) { // they are those that a solve has found
    const found = solved.filter(({ request: { options, solve } }) => (options ?? solve)?.lights === "unknown");
    modes.light = ofJob("Light", found, async (parent) => mountLight(parent, identifier, await viewOf(found[0].id, parent), environments, { canRender: false }));
  }
  modes.maps = ofJob("Maps", solved, maps(solved[0]));
  modes["3d"] = ofJob("3-D", exported, (parent) => mountAsset(parent, exported[0]));
  if (view.info.frames.length > 0) modes.photographs = { title: "Photographs", mount: (parent) => mountPhotographed(parent, view) };
  modes.depth = ofJob("Depth", measured, maps(measured[0]));
  modes.frames = ofJob("Frames", relit, (parent) => mountFrames(parent, relit, nameOf));
  for (const [each, compared] of [["compare", solved], ["compare-depths", measured]]) {
    if (compared.length > 1) modes[each] = { title: each === "compare" ? "Compare" : "Compare depths", job: compared[0].id, mount: (parent) => mountCompared(parent, compared) };
  }
  return Object.fromEntries(Object.entries(modes).filter(([, mode]) => mode !== undefined));
}

/** Return what a job is called beside others of the object. */
function nameOf(job) {
  return `${job.request.name || job.request.options?.method || kindTitle(job.request.kind)} (${new Date(job.created_at).toLocaleString([], { dateStyle: "short", timeStyle: "short" })})`;
}

async function mountPhotographed(parent, view) {
  const [dome, frames] = [element("div", { id: "dome" }), element("div", { class: "thumbnails", tabindex: 0, role: "region", "aria-label": "Thumbnails of the photographs" })];
  parent.replaceChildren(warningsOf(view), element("div", { class: "columns" }, dome, frames));
  await mountPhotographs(frames, dome, view);
}

/** Show the maps of two jobs beside each other, which a person chooses; at first the two newest. */
async function mountCompared(parent, jobs) {
  const choice = (label, index) => element("select", { "aria-label": label }, ...jobs.map((job, at) => element("option", { value: job.id, selected: at === index }, nameOf(job))));
  const [first, second] = [choice("Maps", 0), choice("Compared with", 1)];
  const place = element("div");
  const again = () => attempt(async () => {
    const wanted = [first.value, second.value];
    const [one, other] = await Promise.all(wanted.map((job) => viewOf(job, place)));
    if (first.value !== wanted[0] || second.value !== wanted[1]) return; // others were chosen meanwhile
    if (one.info.rows !== other.info.rows || one.info.cols !== other.info.cols) throw new Error("these maps have different sizes");
    await mountResults(place, one, [{ name: second.selectedOptions[0].textContent, view: other }]);
  });
  for (const each of [first, second]) each.addEventListener("change", again);
  parent.replaceChildren(element("p", { class: "actions" }, element("label", {}, "Maps ", first), element("label", {}, "compared with ", second)), place);
  await again();
}
