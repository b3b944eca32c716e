/** The modes of an object: what there is to show of it, and how each is shown. */

import { attempt } from "../api.js";
import { element, kindTitle } from "../element.js";
import { ControlAddress } from "../view/control_address.js";
import { mountAsset } from "./asset.js";
import { mountFrames } from "./frames.js";
import { mountLight } from "./light.js";
import { hasUnknownLights } from "./next_steps.js";
import { mountPhotographs } from "./photographs.js";
import { mountResults, viewOf, warningsOf } from "./results.js";

const MAPS = ["solve", "pipeline", "join"]; // kinds of jobs that make maps

/**
 * Return the modes that an object has, by name: what each is called, how it is mounted, and the job that it shows at first, if one.
 * @param {string} identifier Of the capture. @param {import("../view/view_file.js").ViewFile} view Of it. @param {number|null} step Of a sequence.
 * @param {any[]} jobs Of the object, the newest first.
 * @param {any} facts Of the capture.
 * @param {any[]} environments Of the server. @param {function(any): void} submitted Is given a job that renders frames.
 */
export function modesOf(identifier, view, step, jobs, facts, environments, submitted) {
  const of = (kinds) => jobs.filter((job) => kinds.includes(job.request.kind));
  const [solved, measured, exported] = [of(MAPS), of(["depth"]), of(["export", "pipeline"])];
  const relit = jobs.filter(({ request: { kind, environment, keys } }) => kind === "relight" || (kind === "pipeline" && Boolean(environment ?? keys)));
  const modes = {};
  const ofJobs = (title, found, mount) => (found.length === 0 ? undefined : { title, job: found[0].id, mount: (parent) => mountOne(parent, title, found, mount) });
  const maps = async (parent, job) => mountResults(parent, await viewOf(job.id, parent));
  if (view.info.relight !== null && step === null) modes.light = { title: "Light", mount: (parent) => mountLight(parent, identifier, view, environments, { submitted }) };
  else if (hasUnknownLights(facts) && step === null) { // they are those that a solve has found
    const found = solved.filter(({ request: { options, solve } }) => (options ?? solve)?.lights === "unknown");
    modes.light = ofJobs("Light", found, async (parent, job) => mountLight(parent, identifier, await viewOf(job.id, parent), environments, { canRender: false }));
  }
  modes.maps = ofJobs("Maps", solved, maps);
  modes["3d"] = ofJobs("3-D", exported, mountAsset);
  if (view.info.frames.length > 0) modes.photographs = { title: "Photographs", mount: (parent) => mountPhotographed(parent, view) };
  modes.depth = ofJobs("Depth", measured, maps);
  modes.frames = ofJobs("Frames", relit, (parent, job) => mountFrames(parent, job.id, view.info.assumed ?? []));
  for (const [each, compared] of [["compare", solved], ["compare-depths", measured]]) {
    if (compared.length > 1) modes[each] = { title: each === "compare" ? "Compare" : "Compare depths", job: compared[0].id, mount: (parent) => mountCompared(parent, compared) };
  }
  return Object.fromEntries(Object.entries(modes).filter(([, mode]) => mode !== undefined));
}

/** Return what a job is called beside others of the object. */
function nameOf(job) {
  return `${job.request.name || job.request.options?.method || kindTitle(job.request.kind)} (${new Date(job.created_at).toLocaleString([], { dateStyle: "short", timeStyle: "short" })})`;
}

/** Show what one of some jobs has made, of which a person chooses; at first the newest. */
async function mountOne(parent, title, jobs, mount) {
  const holder = element("div");
  const chosen = element("select", {}, ...jobs.map((job) => element("option", { value: job.id }, nameOf(job))));
  const address = new ControlAddress({ of: chosen });
  address.read();
  const show = () => {
    const place = element("div", {}, element("p", { class: "help", role: "status" }, "Loading …")); // of its own: what comes late of another job is not seen
    holder.replaceChildren(place);
    return mount(place, jobs[chosen.selectedIndex]);
  };
  chosen.addEventListener("change", () => { address.write(); attempt(show); });
  parent.replaceChildren(element("p", { class: "actions", hidden: jobs.length === 1 && title !== "Frames" }, element("label", {}, `${title} of `, chosen)), holder);
  await show();
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
  const address = new ControlAddress({ of: first, beside: second });
  address.read();
  for (const each of [first, second]) each.addEventListener("change", () => { address.write(); again(); });
  parent.replaceChildren(element("p", { class: "actions" }, element("label", {}, "Maps ", first), element("label", {}, "compared with ", second)), place);
  await again();
}
