/** The page of one object: what was captured and what was made of it, as modes of one view. Its address says which is shown, and how. */

import { attempt, listing, load, read, resultsOf, save } from "../api.js";
import { byId, bytes, element, factText, show, words } from "../element.js";
import { Address, writeNow } from "../publish/address.js";
import { ViewFile } from "../view/view_file.js";
import { chosenStep } from "../time_steps.js";
import { openView } from "../view_jobs.js";
import { mountAsset } from "./asset.js";
import { mountLight } from "./light.js";
import { litFacts, offerSteps } from "./next_steps.js";
import { mountPhotographs } from "./photographs.js";
import { removeLater } from "./removal.js";
import { mountResults, PREVIEW, viewOf, warningsOf } from "./results.js";

const identifier = byId("main").dataset.identifier;
const MAPS = ["solve", "pipeline", "join"]; // kinds of jobs that make maps
const MADE_BY = { pipeline: ["solve"], export: ["pipeline"] }; // what need not be done any more where a kind has succeeded
const SAVED = /(^|\/)(asset\.(usdz|usda|usdc|glb)|maps\.exr|depth\.exr|points\.ply|mesh\.ply|report\.json|annotations\.json)$/;
const address = new Address({ mode: 0 });
const places = new Map(); // of the modes that were shown
const left = new Map(); // what the address said beside the mode when each was left
let modes = {};
let shown = null;

/** Return the jobs of this object that have succeeded, the newest first: those of its capture, and those that go on with their results. */
async function jobsOfObject() {
  const all = [];
  for await (const job of listing("/v1/jobs?limit=500&state=succeeded", "jobs")) all.push(job);
  const known = new Set();
  for (const job of all.toReversed()) if (job.request.capture === identifier || known.has(job.request.maps)) known.add(job.id);
  return all.filter((job) => known.has(job.id) && job.request.kind !== "view" && job.request.name !== PREVIEW);
}

/** Return the modes that this object has: what each is called and how it is mounted. */
function modesOf(view, step, jobs) {
  const of = (kinds) => jobs.filter((job) => kinds.includes(job.request.kind));
  const [solved, measured, exported] = [of(MAPS), of(["depth"]), of(["export", "pipeline"])];
  const nameOf = (job) => `${job.request.name || job.request.options?.method || job.request.kind} (${new Date(job.created_at).toLocaleString([], { dateStyle: "short", timeStyle: "short" })})`;
  const modes = {};
  if (view.info.relight !== null && step === null) modes.light = { title: "Light", mount: (parent) => mountLight(parent, identifier, view) };
  if (solved.length > 0) modes.maps = { title: "Maps", mount: async (parent) => mountResults(parent, await viewOf(solved[0].id, parent)) };
  if (exported.length > 0) modes["3d"] = { title: "3-D", mount: (parent) => mountAsset(parent, exported[0]) };
  if (view.info.frames.length > 0) {
    modes.photographs = { title: "Photographs", mount: async (parent) => {
      const [dome, frames] = [element("div", { id: "dome" }), element("div", { class: "thumbnails", tabindex: 0, role: "region", "aria-label": "Thumbnails of the photographs" })];
      parent.replaceChildren(warningsOf(view), element("div", { class: "columns" }, dome, frames));
      await mountPhotographs(frames, dome, view);
    } };
  }
  if (measured.length > 0) modes.depth = { title: "Depth", mount: async (parent) => mountResults(parent, await viewOf(measured[0].id, parent)) };
  if (solved.length > 1) modes.compare = { title: "Compare", mount: (parent) => mountCompared(parent, solved, nameOf) };
  return modes;
}

/** Show the maps of two jobs beside each other, which a person chooses; at first the two newest. */
async function mountCompared(parent, jobs, nameOf) {
  const choice = (label, index) => element("select", { "aria-label": label }, ...jobs.map((job, at) => element("option", { value: job.id, selected: at === index }, nameOf(job))));
  const [first, second] = [choice("Maps", 0), choice("Compared with", 1)];
  const place = element("div");
  const again = () => attempt(async () => {
    const [one, other] = await Promise.all([first.value, second.value].map((job) => viewOf(job, place)));
    if (one.info.rows !== other.info.rows || one.info.cols !== other.info.cols) throw new Error("these maps have different sizes");
    await mountResults(place, one, [{ name: second.selectedOptions[0].textContent, view: other }]);
  });
  for (const each of [first, second]) each.addEventListener("change", again);
  parent.replaceChildren(element("p", { class: "actions" }, element("label", {}, "Maps ", first), element("label", {}, "compared with ", second)), place);
  await again();
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

async function presentFiles(jobs) {
  const seen = new Set();
  for (const job of jobs) {
    for await (const result of listing(`/v1/jobs/${job.id}/results`, "results", "after")) {
      const name = result.name.split("/").at(-1);
      if (!SAVED.test(result.name) || seen.has(name)) continue; // the newest of each name
      seen.add(name);
      if (name === "report.json") byId("report").textContent = JSON.stringify(await resultsOf(job.id).json(result.name), null, 1);
      else byId("files").append(element("li", {}, element("a", { href: result.url, onclick: (event) => { event.preventDefault(); attempt(() => save(result.url)); } }, name), ` ${bytes(result.size)}`));
    }
  }
  show(byId("report-part"), seen.has("report.json"));
  show(byId("files-part"), byId("files").children.length > 0);
}

await load(async () => {
  const capture = await read(`/v1/captures/${identifier}`);
  byId("name").textContent = capture.name;
  document.title = `${capture.name} · Relit`;
  byId("facts").replaceChildren(...Object.entries(capture.facts ?? {}).flatMap(([name, value]) => [element("dt", {}, words(name)), element("dd", {}, factText(name, value))]));
  byId("delete").addEventListener("click", () => removeLater(`/v1/captures/${identifier}`, capture.name, "/captures"));
  if (capture.state !== "ready") {
    byId("view").replaceChildren(element("p", {}, `${capture.problem ?? `This capture is ${capture.state}.`} `, element("a", { href: `/captures/${identifier}` }, "Its page says more.")));
    return;
  }
  const step = await chosenStep(identifier);
  const [view, jobs] = await Promise.all([openView(identifier, null, step, byId("view")).then(({ files }) => ViewFile.open(files)), jobsOfObject()]);
  modes = modesOf(view, step, jobs);
  offerSteps(byId("next"), litFacts(capture.facts ?? {}, view), identifier, jobs.flatMap(({ request: { kind } }) => [kind, ...(MADE_BY[kind] ?? [])]));
  const wanted = { mode: "" };
  address.read(wanted);
  byId("modes").replaceChildren(...Object.entries(modes).map(([name, { title }]) => element("button", { type: "button", class: "quiet", "data-mode": name, "aria-pressed": "false",
    onclick: () => go(name) }, title)));
  const first = wanted.mode in modes ? wanted.mode : Object.keys(modes)[0];
  if (first === undefined) byId("view").replaceChildren(element("p", {}, "There is nothing to show of this capture yet."));
  else {
    address.write({ mode: first });
    addEventListener("hashchange", follow);
    await choose(first);
  }
  await presentFiles(jobs);
});
