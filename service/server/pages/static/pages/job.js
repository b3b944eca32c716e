/** The page of one job: progress, stages, log and results, and what can be done with it. */

import { attempt, listing, load, post, read, resultsOf, save, warningsIn } from "../api.js";
import { byId, bytes, element, show, time } from "../element.js";
import { watch } from "../events.js";
import { enableForms } from "../form.js";
import { progressOf, titleOf } from "../jobs_table.js";
import { setPrimary } from "../object/next_steps.js";
import { removeLater } from "../object/removal.js";
import { newest, once } from "../once.js";
import { requestRows } from "../object/request.js";
import { reloadWhenBack } from "../repeat.js";

const identifier = byId("main").dataset.identifier;
const ENDED = ["succeeded", "failed", "cancelled"];
const MAPS = ["maps.exr", "depth.exr"];
const SEQUENCE = "sequence.json";
const SHOWN_AS = { relight: "frames", solve: "maps", depth: "depth" }; // modes of the page of an object
const asked = newest();
const warnings = new Set();
let logged = "";
let shown = null; // the job as it was told last

function present(job) {
  if (job.revision < shown?.revision) return; // an answer that was overtaken
  shown = job;
  document.title = `${titleOf(job)} · Relit`;
  byId("name").textContent = titleOf(job);
  byId("state").replaceChildren(element("span", { class: `state ${job.state}` }, job.state), job.attempt > 1 ? ` attempt ${job.attempt}` : "");
  show(byId("progress"), job.state === "running");
  const bar = byId("bar");
  if (job.progress?.total > 0) Object.assign(bar, { max: job.progress.total, value: job.progress.done });
  else bar.removeAttribute("value");
  byId("stage").textContent = progressOf(job);
  show(byId("error"), job.error !== null);
  byId("error").textContent = job.error ?? "";
  const ended = ENDED.includes(job.state);
  show(byId("cancel"), !ended);
  show(byId("retry"), job.state === "failed" && job.request.kind !== "check");
  show(byId("resume"), job.state === "cancelled" && job.request.kind !== "check");
  show(byId("delete"), ended);
  const happened = `${job.attempt} ${job.state} ${job.progress?.stage}`;
  if (happened !== logged) attempt(log);
  logged = happened;
}

/** Show what was asked for as the form of its kind names it: inputs and what differs from the defaults, and the rest folded away. */
async function presentRequest(job) {
  const { chosen, usual } = await requestRows(job);
  byId("request").replaceChildren(...chosen);
  byId("usual").replaceChildren(...usual);
  show(byId("usual-part"), usual.length > 0);
}

async function log() {
  const isNewest = asked();
  const { entries } = await read(`/v1/jobs/${identifier}/log`);
  if (!isNewest()) return;
  byId("log").replaceChildren(...entries.map((entry) => element("li", {}, time(entry.at), ` attempt ${entry.attempt}: ${entry.text}`)));
  warn(warningsIn(entries));
}

/** Show warnings beside those that are shown: the log has those of results without a report too. */
function warn(sentences) {
  sentences.forEach((sentence) => warnings.add(sentence));
  byId("warnings").replaceChildren(...[...warnings].map((warning) => element("li", {}, warning)));
}

async function presentResults(job) {
  const rows = [];
  const names = [];
  for await (const result of listing(`/v1/jobs/${identifier}/results`, "results", "after")) {
    names.push(result.name);
    rows.push(element("tr", {}, element("td", {}, element("a", { href: result.url, onclick: (event) => download(event, result) }, result.name)),
      element("td", {}, bytes(result.size))));
  }
  byId("results").tBodies[0].replaceChildren(...(rows.length > 0 ? rows : [element("tr", {}, element("td", { colspan: 2 }, ENDED.includes(job.state) ? "No files." : "No files yet."))]));
  const solved = job.state === "succeeded" && [...MAPS, SEQUENCE].some((name) => names.includes(name));
  offer("look", solved, `/maps/${identifier}`);
  offer("object", job.state === "succeeded" && job.request.capture !== undefined, `/object/${job.request.capture}#mode=${SHOWN_AS[job.request.kind] ?? ""}`);
  offer("cues", job.state === "succeeded" && names.includes("cues.json"), `/drive/${identifier}`);
  offer("asset", job.state === "succeeded" && names.some((name) => /^asset\.(usdz|glb)$/.test(name)), `/asset/${identifier}`);
  offer("light", job.request.capture !== undefined && job.request.kind !== "depth" && !names.includes(SEQUENCE), `/light/${job.request.capture}`);
  setPrimary(byId("object").parentElement);
  const forms = [...byId("work").querySelectorAll("form[data-kind]")];
  const fitting = job.state === "succeeded" ? forms.filter((form) => form.closest(".job-form").dataset.begins.split(" ").some((name) => names.includes(name))) : [];
  if (fitting.length > 0 && byId("work").hidden) {
    forms.forEach((form) => show(form.closest(".job-form"), fitting.includes(form)));
    show(byId("work"), true);
    enableForms(byId("work"), identifier);
  }
  if (names.includes("report.json")) presentReport(await resultsOf(identifier).json("report.json"));
}

function presentReport(report) {
  const stages = Object.entries(report.timings_s ?? report.timings ?? {});
  byId("stages").tBodies[0].replaceChildren(...stages.map(([name, seconds]) => element("tr", {}, element("td", {}, name),
    element("td", {}, typeof seconds === "number" ? seconds.toFixed(2) : String(seconds)))));
  warn(report.warnings ?? []);
}

function offer(id, possible, href) {
  byId(id).href = href;
  show(byId(id), possible);
}

function download(event, result) {
  event.preventDefault();
  attempt(() => save(result.url));
}

async function follow() {
  let job = await read(`/v1/jobs/${identifier}`);
  const request = attempt(() => presentRequest(job));
  present(job);
  const results = attempt(() => presentResults(job)); // the job is followed whether or not they can be had now
  await request;
  if (ENDED.includes(job.state)) {
    await results;
    return;
  }
  attempt(async () => { // for as long as the job runs, while the page shows how far it is
    await watch(`/v1/jobs/${identifier}/events`, { job: (now) => { job = now; present(now); } });
    await ended();
  }, { again: reloadWhenBack, onaway: reloadWhenBack });
}

async function ended() {
  const job = await read(`/v1/jobs/${identifier}`);
  present(job);
  await presentResults(job);
}

for (const [id, action] of Object.entries({ cancel: "cancel", retry: "retry", resume: "resume" })) {
  byId(id).addEventListener("click", () => attempt(() => once(byId(id), async () => {
    present(await post(`/v1/jobs/${identifier}/${action}`));
    if (action !== "cancel") await follow();
  })));
}
byId("delete").addEventListener("click", () => removeLater(`/v1/jobs/${identifier}`, byId("name").textContent, "/jobs"));
await load(follow);
