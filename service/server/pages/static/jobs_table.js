/** Rows of jobs in a table, which follow the events of the server. */

import { duration, element, kindTitle, time } from "./element.js";

/** Return what a job is called, with the capture that it is about; `nameOf` gives the name of a capture or environment, or undefined. */
export function titleOf({ request }, nameOf = () => undefined) {
  const about = nameOf(request.capture ?? request.intake);
  return request.name || (about === undefined ? kindTitle(request.kind) : `${kindTitle(request.kind)} · ${about}`);
}

/** Return how far a job is, in words. */
export function progressOf(job) {
  if (job.error !== null) return job.error;
  const { progress } = job;
  if (job.state !== "running" || progress === null) return "";
  const left = progress.remaining_s === null ? "" : `, ${duration(progress.remaining_s)} left`;
  return `${progress.stage} ${progress.done} of ${progress.total}${left}`;
}

/** Return how far a job is where nothing beside these words tells its state. */
export function doingOf(job) {
  return job.state === "queued" ? "waits for a free worker" : progressOf(job) || job.state;
}

/** Jobs in the body of a table, the newest first. */
export class JobsTable {
  #rows = new Map();
  #revisions = new Map();
  #body;
  #wanted;
  #nameOf;

  /**
   * @param {HTMLTableElement} table With a head of four columns.
   * @param {function(any): boolean} [wanted] Which jobs are shown.
   * @param {function(string): string|undefined} [nameOf] As `titleOf` takes it.
   */
  constructor(table, wanted = () => true, nameOf = undefined) {
    this.#body = table.tBodies[0];
    this.#wanted = wanted;
    this.#nameOf = nameOf;
  }

  /** Return how many jobs are shown. */
  get size() {
    return this.#rows.size;
  }

  /** Show a job as it is now. */
  put(job) {
    if (!this.#wanted(job) || job.revision < this.#revisions.get(job.id)) return; // an answer that was overtaken
    this.#revisions.set(job.id, job.revision);
    const row = element("tr", { "data-created": job.created_at },
      element("td", {}, element("a", { href: `/jobs/${job.id}` }, titleOf(job, this.#nameOf)), " ", element("small", {}, job.id)),
      element("td", {}, element("span", { class: `state ${job.state}` }, job.state)),
      element("td", {}, ...bar(job), progressOf(job)),
      element("td", {}, time(job.created_at)));
    const before = this.#rows.get(job.id);
    if (before !== undefined) { // its link stays, and with it the focus and a click that has begun
      [...row.cells].forEach((cell, at) => at > 0 && before.cells[at].replaceWith(cell));
      return;
    }
    const older = [...this.#body.rows].find((other) => other.dataset.created < job.created_at);
    this.#body.insertBefore(row, older ?? null);
    this.#rows.set(job.id, row);
  }

  /** Remove a job that was deleted. */
  drop(identifier) {
    this.#rows.get(identifier)?.remove();
    this.#rows.delete(identifier);
  }
}

function bar(job) {
  if (job.state !== "running" || job.progress === null || job.progress.total === 0) return [];
  return [element("progress", { value: job.progress.done, max: job.progress.total, "aria-label": `Progress of ${titleOf(job)}` }), " "];
}
