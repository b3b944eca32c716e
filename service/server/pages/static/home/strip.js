/** The jobs that run, wait or have failed lately, in a strip, with the reason why each waits. */

import { element, setChildren, show } from "../element.js";
import { doingOf } from "../jobs_table.js";

const FAILED_HOURS = 24;
const MOST_FAILED = 3;
const ACTIVE = ["running", "queued"];
const lines = new Map(); // of the jobs that were shown

/**
 * Return why a job waits.
 * @param {any} job That is queued.
 * @param {any[]} active Jobs of the project that run or wait.
 * @param {function(any): string} title Of a job.
 * @param {string} fault What keeps the service from work, or an empty text.
 */
function reasonOf(job, active, title, fault) {
  const isBefore = (other) => other.state === "running" || other.priority > job.priority
    || (other.priority === job.priority && other.created_at < job.created_at);
  const before = active.filter((other) => other.id !== job.id && other.request.kind !== "check" && isBefore(other));
  if (before.length === 0) return fault === "" ? doingOf(job) : `waits: ${fault}`;
  const [first] = before.sort((one, other) => ACTIVE.indexOf(one.state) - ACTIVE.indexOf(other.state));
  const doing = first.state === "running" ? "which runs" : "which waits too";
  return before.length === 1 ? `behind ${title(first)}, ${doing}` : `behind ${before.length} jobs, first ${title(first)}, ${doing}`;
}

/** Show jobs. */
export function showStrip(strip, jobs, title, fault) {
  const active = jobs.filter((job) => ACTIVE.includes(job.state));
  const since = Date.now() - FAILED_HOURS * 3_600_000;
  const failed = jobs.filter((job) => job.state === "failed" && Date.parse(job.finished_at) > since).slice(0, MOST_FAILED);
  const shown = [...active.filter((job) => job.state === "running"), ...failed, ...active.filter((job) => job.state === "queued")];
  setChildren(strip, shown.map((job) => {
    if (!lines.has(job.id)) lines.set(job.id, element("li", {}, element("a", { href: `/jobs/${job.id}` })));
    const line = lines.get(job.id);
    line.className = job.state;
    line.firstChild.textContent = title(job);
    const isMeasured = job.state === "running" && job.progress?.total > 0;
    setChildren(line, [line.firstChild,
      ...(isMeasured ? [element("progress", { value: job.progress.done, max: job.progress.total, "aria-label": `Progress of ${title(job)}` })] : []),
      element("p", {}, job.state === "queued" ? reasonOf(job, active, title, fault) : doingOf(job))]);
    return line;
  }));
  show(strip, shown.length > 0);
}
