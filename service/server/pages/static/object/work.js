/** The jobs under way for an object, on its own page: how far each is, and how it ended. */

import { attempt, listing, post, read } from "../api.js";
import { element, kindTitle } from "../element.js";
import { once } from "../once.js";
import { watch } from "../events.js";
import { doingOf } from "../jobs_table.js";

const LEFT_OUT = ["view", "check"]; // what pages do on their own
const ENDED = ["succeeded", "failed", "cancelled"];

/** Lines of jobs, in a list of the page. */
export class Work {
  #box;
  #done;
  #lines = new Map();
  #stop = null; // ends the stream of events

  /**
   * @param {HTMLElement} box Takes a line for each job.
   * @param {function(any): Promise<void>} done Is given a job that has succeeded; its line goes afterwards.
   */
  constructor(box, done) {
    this.#box = box;
    this.#done = done;
  }

  /** Show a job until it has succeeded, and return when it has ended; one that fails stays, with its reason. */
  follow(job) {
    const [bar, words] = [element("progress", { "aria-label": `Progress of ${kindTitle(job.request.kind)}` }), element("span", { role: "status" })];
    const button = element("button", { type: "button", class: "quiet", onclick: () => attempt(() => once(line, () => this.#act(job.id))) });
    const line = element("li", { "data-job": job.id }, element("strong", {}, kindTitle(job.request.kind)), bar, button, element("a", { href: `/jobs/${job.id}` }, "Details"), words);
    const ended = new Promise((end) => { this.#lines.set(job.id, { line, bar, words, button, end, state: "" }); });
    this.#box.append(line);
    this.#present(job);
    this.#watch();
    return ended;
  }

  async #act(id) {
    const action = { failed: "retry", cancelled: "resume" }[this.#lines.get(id).state] ?? "cancel";
    this.#present(await post(`/v1/jobs/${id}/${action}`));
    this.#watch();
  }

  #watch() {
    if (this.#stop !== null) return;
    this.#stop = new AbortController();
    const again = () => attempt(() => Promise.all([...this.#lines.keys()].map(async (id) => this.#present(await read(`/v1/jobs/${id}`)))));
    attempt(() => watch("/v1/events", { job: (job) => this.#present(job) }, { onopen: again, signal: this.#stop.signal }));
  }

  #present(job) {
    const shown = this.#lines.get(job.id);
    if (shown === undefined || shown.state === "succeeded" || job.revision < shown.revision) return; // an answer that was overtaken
    const { line, bar, words, button, end } = shown;
    shown.revision = job.revision;
    shown.state = line.className = job.state;
    words.textContent = doingOf(job);
    if (job.state === "running" && job.progress?.total > 0) Object.assign(bar, { max: job.progress.total, value: job.progress.done });
    else bar.removeAttribute("value");
    bar.hidden = ENDED.includes(job.state);
    button.hidden = job.state === "succeeded";
    button.textContent = { failed: "Try again", cancelled: "Resume" }[job.state] ?? "Stop";
    if (job.state === "succeeded") attempt(() => this.#done(job)).finally(() => { line.remove(); this.#lines.delete(job.id); end(); });
    else if (ENDED.includes(job.state)) end();
    if ([...this.#lines.values()].some(({ state }) => !ENDED.includes(state))) return;
    this.#stop?.abort();
    this.#stop = null;
  }
}

/** Return the jobs that run or wait, of those whose request is `wanted`. */
export async function jobsUnderWay(wanted) {
  const found = [];
  for await (const job of listing("/v1/jobs?limit=500&state=running&state=queued", "jobs")) {
    if (!LEFT_OUT.includes(job.request.kind) && wanted(job.request)) found.push(job);
  }
  return found;
}
