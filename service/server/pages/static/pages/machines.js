/** The page for operators: workers and what each does, the queue, the space left, the last errors, and the audit log. */

import { attempt, load, post, read, Refusal } from "../api.js";
import { byId, bytes, element, icon, setChildren, show, time, words } from "../element.js";
import { newest, once } from "../once.js";
import { progressOf, titleOf } from "../jobs_table.js";

const REFRESH_MS = 5000;
const ERRORS = 10;
const QUESTIONS = { drain: "Let this worker finish its step, give its job back and end?", kill: "Kill this worker at once? Its step is lost; another worker goes on with the job." };
const PAGES = { cap: "captures", job: "jobs" }; // of identifiers
const shown = new Map(); // of each worker, the line that it has and what that says
const asked = newest();
let next = null; // page of the audit log

async function look() {
  const isNewest = asked();
  const [machines, { jobs: failed }] = await Promise.all([read("/v1/machines"), read(`/v1/jobs?state=failed&limit=${ERRORS}`)]);
  if (!isNewest()) return;
  show(byId("view"), true);
  byId("faults").replaceChildren(...machines.faults.map((fault) => element("li", {}, fault)));
  setChildren(byId("workers"), lines(machines.workers.map(lineOf), "No worker was seen lately."));
  byId("errors").replaceChildren(...lines(failed.map(errorLine), "No job of this project has failed."));
  const { disk } = machines;
  const figures = { ...Object.fromEntries(Object.entries(machines.jobs).map(([state, count]) => [`Jobs ${state}`, String(count)])),
    "Longest wait": machines.queued_since === null ? "nothing waits" : element("span", {}, "since ", time(machines.queued_since)),
    "Space left": element("span", {}, `${bytes(disk.free)} of ${bytes(disk.total)} `,
      element("meter", { min: 0, max: disk.total, value: disk.total - disk.free, "aria-label": "Space used" }), ` uploads and jobs need ${bytes(disk.least_free)}`) };
  byId("figures").replaceChildren(...Object.entries(figures).flatMap(([name, value]) => [element("dt", {}, name), element("dd", {}, value)]));
}

function lines(found, nothing) {
  return found.length > 0 ? found : [element("li", { class: "help" }, nothing)];
}

/** Return the line of a worker, the same one as long as nothing changes but when the worker was seen. */
function lineOf({ seen_at: seen, ...worker }) {
  const says = JSON.stringify(worker);
  if (shown.get(worker.id)?.says !== says) shown.set(worker.id, { says, line: workerLine(worker) });
  const { line } = shown.get(worker.id);
  line.querySelector("small").replaceChildren("began ", time(worker.started_at), ", seen ", time(seen));
  return line;
}

function workerLine(worker) {
  const { job } = worker;
  const doing = job !== null ? [element("a", { href: `/jobs/${job.id}` }, titleOf(job)), ` ${progressOf(job)}`]
    : [worker.busy ? "does a job of another project" : "waits for work"];
  const ask = (what) => attempt(async () => {
    if (!confirm(QUESTIONS[what])) return;
    await post(`/v1/machines/${encodeURIComponent(worker.id)}/${what}`);
    await look();
  });
  const button = (what) => element("button", { type: "button", class: "quiet", "aria-label": `${words(what)} ${worker.device}, process ${worker.pid}`,
    disabled: worker.asked === "kill" || worker.asked === what, onclick: () => ask(what) }, words(what));
  return element("li", {}, icon("machine"), element("div", {}, element("strong", {}, worker.device),
    ` ${worker.host}, process ${worker.pid} `, element("span", { class: `state ${worker.state}` }, worker.state), worker.asked === null ? null : ` (asked to ${worker.asked === "kill" ? "end" : "drain"})`,
    element("p", {}, ...doing), element("small")),
    element("div", { class: "actions" }, button("drain"), button("kill")));
}

function errorLine(job) {
  return element("li", {}, icon("warning"), element("div", {}, element("a", { href: `/jobs/${job.id}` }, titleOf(job)), " ", element("small", {}, time(job.finished_at)),
    element("p", { class: "fault" }, job.error)));
}

async function audit() {
  const page = await read(next === null ? "/v1/audit?limit=50" : `/v1/audit?limit=50&before=${next}`);
  byId("audit").tBodies[0].append(...page.entries.map((entry) => element("tr", {}, element("td", {}, time(entry.at)), element("td", {}, entry.actor),
    element("td", {}, words(entry.action).replace(".", ": ")), element("td", {}, objectLink(entry.object)), element("td", {}, entry.request ?? "command line"))));
  if (page.entries.length === 0 && next === null) byId("audit").tBodies[0].append(element("tr", {}, element("td", { colspan: 5 }, "Nobody has changed anything yet.")));
  next = page.next;
  show(byId("more"), next !== null);
}

function objectLink(name) {
  const page = /^(cap|job)_[0-9a-z]+$/.test(name) ? PAGES[name.slice(0, 3)] : undefined;
  return page === undefined ? name : element("a", { href: `/${page}/${name}` }, name);
}

byId("more").addEventListener("click", () => attempt(() => once(byId("more"), audit)));
await load(async () => {
  try {
    await Promise.all([look(), audit()]);
  } catch (error) {
    if (!(error instanceof Refusal) || error.status !== 403) throw error;
    byId("refused").textContent = `This page is for operators: ${error.message}. Give a key of that scope with the button Key above.`;
    show(byId("refused"), true);
    return;
  }
  setInterval(() => document.visibilityState === "visible" && attempt(look), REFRESH_MS);
});
