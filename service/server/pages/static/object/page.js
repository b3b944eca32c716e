/** The page of one object: what was captured and what was made of it, as modes of one view. Its address says which is shown, and how. */

import { attempt, listing, load, reveal, submitJob } from "../api.js";
import { byId, element, factRows, show } from "../element.js";
import { readyEnvironments } from "../environments.js";
import { Address, writeNow } from "../publish/address.js";
import { newest, once } from "../once.js";
import { ViewFile } from "../view/view_file.js";
import { chosenStep } from "../time_steps.js";
import { checked, openView } from "../view_jobs.js";
import { newestFiles, presentFiles, presentReport, savingLink } from "./files.js";
import { offerFusion } from "./fusion.js";
import { modesOf } from "./modes.js";
import { litFacts, offerSteps, setPrimary } from "./next_steps.js";
import { removeLater } from "./removal.js";
import { PREVIEW } from "./results.js";
import { jobsUnderWay, Work } from "./work.js";

const identifier = byId("main").dataset.identifier;
const MADE_BY = { pipeline: ["solve"], solve: ["pipeline"], export: ["pipeline"] }; // what need not be done any more where a kind has succeeded
const EXPORTED = ["maps.exr", "points.ply"]; // files of the jobs that an asset can be made of
const address = new Address({ mode: 0 });
const places = new Map(); // of the modes that were shown
const known = new Set(); // jobs of this object that have succeeded
const left = new Map(); // what the address said beside the mode when each was left
let modes = {};
let shown = null;

/** Return whether a job is asked of this object, or of what other jobs have made of it. */
function isOfObject({ capture, maps, registered, depths = [] }) {
  return capture === identifier || [maps, registered, ...depths].some((each) => known.has(each));
}

/** Return the jobs of this object that have succeeded, the newest first: those of its capture, and those that go on with their results. */
async function jobsOfObject() {
  const all = [];
  for await (const job of listing("/v1/jobs?limit=500&state=succeeded", "jobs")) all.push(job);
  for (const job of all.toReversed()) if (isOfObject(job.request)) known.add(job.id);
  return all.filter((job) => known.has(job.id) && job.request.kind !== "view" && job.request.name !== PREVIEW);
}

/** Show a mode; one that was shown before is as it was left. */
async function choose(name) {
  shown = name;
  for (const tab of byId("modes").children) tab.setAttribute("aria-pressed", String(tab.dataset.mode === name));
  for (const [each, place] of places) show(place, each === name);
  if (places.has(name)) return;
  const place = element("div", { "data-shows": name });
  places.set(name, place);
  byId("view").querySelector(".skeleton")?.remove();
  byId("view").append(place);
  await load(() => modes[name].mount(place));
}

/** Return what an address says beside the mode. */
function others(hash = location.hash) {
  return hash.slice(1).split("&").filter((part) => part !== "" && !part.startsWith("mode=")).join("&");
}

/** Show another mode, from which Back returns to this one. */
function go(name) {
  if (name === shown) return undefined;
  writeNow();
  left.set(shown, others());
  history.pushState(null, "", `#${[`mode=${name}`, others()].filter((part) => part !== "").join("&")}`);
  return choose(name);
}

/** Show what the address says after Back, Forward or a link: a mode as it was left, or else the page is loaded again. */
function follow({ oldURL }) {
  left.set(shown, others(new URL(oldURL).hash));
  const wanted = { mode: Object.keys(modes)[0] };
  address.read(wanted);
  const isKnown = wanted.mode in modes && wanted.mode !== shown && (!places.has(wanted.mode) || left.get(wanted.mode) === others());
  if (!isKnown) location.reload();
  else choose(wanted.mode);
}

/** Take the modes of what there is now; one that showed an older job is shown anew when it is chosen. */
function takeModes(found) {
  for (const [name, { job }] of Object.entries(found)) {
    if (name === shown || job === modes[name]?.job) continue;
    places.get(name)?.remove();
    places.delete(name);
  }
  modes = found;
  byId("modes").replaceChildren(...Object.entries(modes).map(([name, { title }]) => element("button", { type: "button", class: "quiet", "data-mode": name,
    "aria-pressed": String(name === shown), onclick: () => go(name) }, title)));
}

/** Show what was made, and what can be made next; the newest asset is one click away. */
async function present(jobs, facts, work) {
  const done = jobs.flatMap(({ request: { kind } }) => [kind, ...(MADE_BY[kind] ?? [])]);
  offerSteps(byId("next"), facts, identifier, done, (job) => followJob(work, job));
  await offerFusion(byId("fusion"), identifier, jobs, (job) => followJob(work, job));
  const files = await newestFiles(jobs);
  offerExport(files.find(({ name }) => EXPORTED.includes(name))?.job, jobs, work);
  presentFiles(byId("files"), files);
  show(byId("files-part"), files.length > 0);
  presentReport(byId("report-part"), files);
  const asset = files.find(({ name }) => name === "asset.usdz");
  byId("save").replaceChildren(...(asset === undefined ? [] : [savingLink(asset, "Save asset.usdz", { class: "button" })]));
  setPrimary(byId("next"));
}

/** Offer an asset of the newest maps or points where there is none, without solving them again. */
function offerExport(source, jobs, work) {
  const button = byId("export");
  show(button, source !== undefined && source.request.kind !== "pipeline" && !jobs.some(({ request: { kind, maps } }) => kind === "export" && maps === source.id));
  button.onclick = () => attempt(() => once(button, async () => followJob(work, await submitJob({ kind: "export", maps: source.id }))));
}

/** Follow a job; the button that asks for such a job rests meanwhile. */
async function followJob(work, job) {
  const rest = (isResting) => byId("next").querySelectorAll(`[data-kind="${job.request.kind}"]`).forEach((button) => { button.disabled = isResting; });
  rest(true);
  await work.follow(job);
  rest(false);
}

await load(async () => {
  const isChecked = () => { byId("view").replaceChildren(element("p", { role: "status" }, "This capture is being checked.")); reveal(); };
  const [capture, jobs, environments] = await Promise.all([checked(identifier, isChecked), jobsOfObject(), readyEnvironments()]);
  byId("name").textContent = capture.name;
  document.title = `${capture.name} · Relit`;
  byId("facts").replaceChildren(...factRows(capture.facts ?? {}));
  byId("delete").addEventListener("click", () => removeLater(`/v1/captures/${identifier}`, capture.name, "/captures"));
  if (capture.state !== "ready") {
    byId("view").replaceChildren(element("p", {}, `${capture.problem ?? `This capture is ${capture.state}.`} `, element("a", { href: `/captures/${identifier}` }, "Its page says more.")));
    return;
  }
  byId("view").querySelector("p")?.remove();
  const step = await chosenStep(capture.facts);
  const viewing = openView(identifier, null, step, byId("view")).then(({ files }) => ViewFile.open(files));
  const asked = newest();
  const work = new Work(byId("work"), async () => {
    const isNewest = asked();
    const [view, now] = await Promise.all([viewing, jobsOfObject()]);
    if (!isNewest()) return; // another job has ended meanwhile, and its look sees both
    const facts = litFacts(capture.facts ?? {}, view);
    takeModes(modesOf(identifier, view, step, now, facts, environments, renders));
    await present(now, facts, work);
  });
  const renders = (job) => { followJob(work, job); byId("work").scrollIntoView({ block: "center" }); };
  const presentAll = (facts) => attempt(async () => {
    await present(jobs, facts, work);
    for (const job of await jobsUnderWay(isOfObject)) followJob(work, job);
  });
  const early = capture.view === null ? presentAll(capture.facts ?? {}) : null; // its view is prepared first, which may wait for other jobs
  const view = await viewing;
  const facts = litFacts(capture.facts ?? {}, view);
  takeModes(modesOf(identifier, view, step, jobs, facts, environments, renders));
  const wanted = { mode: "" };
  address.read(wanted);
  const first = wanted.mode in modes ? wanted.mode : Object.keys(modes)[0];
  const presented = early ?? presentAll(facts);
  if (first === undefined) byId("view").replaceChildren(element("p", {}, "There is nothing to show of this capture yet."));
  else {
    address.write({ mode: first });
    addEventListener("hashchange", follow);
    await choose(first);
  }
  await presented;
});
