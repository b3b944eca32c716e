/** The jobs that the home page knows: those that have not ended, and those that failed lately. */

import { listing, read } from "../api.js";
import { watch } from "../events.js";

const MOST_FAILED = 10;

export class Jobs {
  #jobs = new Map();
  #changed;
  fault = ""; // what keeps the service from work

  /** @param {function(any|null): void} changed Is told the job that has changed; null: all are new. */
  constructor(changed) {
    this.#changed = changed;
  }

  /** Return them, the newest first. */
  get all() {
    return [...this.#jobs.values()].sort((one, other) => (one.created_at < other.created_at ? 1 : -1));
  }

  /** Return how many run or wait. */
  get active() {
    return this.all.filter((job) => ["queued", "running"].includes(job.state)).length;
  }

  /** Know a job that was submitted, before the server tells of it. */
  take(job) {
    this.#know(job);
    this.#changed(job);
  }

  /** Keep a job as it is now, unless a later answer has come before. */
  #know(job) {
    if (!(job.revision < this.#jobs.get(job.id)?.revision)) this.#jobs.set(job.id, job);
  }

  async load() {
    const failed = read(`/v1/jobs?limit=${MOST_FAILED}&state=failed`).then(({ jobs }) => jobs.forEach((job) => this.#know(job)));
    const active = async () => { for await (const job of listing("/v1/jobs?limit=500&state=queued&state=running", "jobs")) this.#know(job); };
    await Promise.all([failed, active()]);
    await this.#askWhatIsWrong();
  }

  follow() {
    return watch("/v1/events", {
      job: async (job) => {
        const isNew = this.#jobs.get(job.id)?.state !== job.state;
        this.#know(job);
        if (isNew && job.state === "queued") await this.#askWhatIsWrong();
        this.#changed(job);
      },
      gone: ({ id }) => { this.#jobs.delete(id); this.#changed(null); },
    });
  }

  async #askWhatIsWrong() {
    if (!this.all.some((job) => job.state === "queued")) return;
    const answer = await fetch("/readyz");
    this.fault = answer.ok ? "" : (await answer.json()).detail;
  }
}
