/** Views, which jobs of the kind `view` prepare: of a capture, or of the maps that a job has made. */

import { listing, read, Refusal, resultsOf, reveal, submitJob } from "./api.js";
import { element } from "./element.js";
import { watch } from "./events.js";
import { doingOf } from "./jobs_table.js";

const CHECKED_MS = 500; // between two looks at a capture that is being checked
const PRIORITY = 75; // of a view that somebody waits for: before what is queued as usual, at 50

/**
 * Return the newest view of a capture or of maps that is prepared or being prepared; null: there is none.
 * @param {{capture?: string, maps?: string|null, step?: number|null}} wanted `maps: null` asks for a view without maps, no `maps` for any;
 *   `step` likewise for the time step of a sequence.
 */
export async function findView(wanted) {
  for await (const job of listing("/v1/jobs?kind=view&limit=500&state=succeeded&state=queued&state=running", "jobs")) {
    const { capture, maps = null, step = null } = job.request;
    if ((wanted.capture ?? capture) !== capture) continue;
    if ((wanted.maps === undefined || wanted.maps === maps) && (wanted.step === undefined || wanted.step === step)) return job;
  }
  return null;
}

/** Return a capture when nothing checks it any more; `tell` is given it as it is until then. */
export async function checked(id, tell) {
  for (;;) {
    const capture = await read(`/v1/captures/${id}`);
    if (capture.state !== "checking") return capture;
    tell(capture);
    await new Promise((resolve) => { setTimeout(resolve, CHECKED_MS); });
  }
}

/** Return the capture that a job comes from, by its maps if it names none; null where none is known. */
export async function captureOf(job) {
  for (let at = job; ; at = await read(`/v1/jobs/${at.request.maps}`)) {
    if (at.request.capture !== undefined) return at.request.capture;
    if (at.request.maps === undefined) return null;
  }
}

/**
 * Return the files of a view, which is prepared first if it is not yet; a place of the page shows how far that is.
 * @param {string} capture Identifier.
 * @param {string|null} maps Identifier of the job that made the maps; null: the capture alone.
 * @param {number|null} step The time step that is shown, where the capture is a sequence.
 * @param {HTMLElement} place Where the view will be shown.
 * @param {object} [more] Of the request.
 * @returns {Promise<{job: any, files: ReturnType<typeof resultsOf>}>}
 */
export async function openView(capture, maps, step, place, more = {}) {
  const body = { kind: "view", priority: PRIORITY, capture, ...(maps === null ? {} : { maps }), ...(step === null ? {} : { step }), ...more };
  let job = (await findView({ capture, maps, step })) ?? (await submitJob(body));
  job = await followed(job, place, "This is looked at for the first time: its view is being prepared.", "The view was not prepared");
  return { job, files: resultsOf(job.id) };
}

/**
 * Return a job when it has succeeded; a place of the page shows how far it is until then, beside what else is here of the page.
 * @param {string} doing A sentence that says what is done. @param {string} fault What is said where it fails, before the reason.
 */
export async function followed(job, place, doing, fault) {
  if (job.state !== "succeeded") {
    const [bar, stage] = [element("progress", { "aria-label": "Progress of the preparation" }), element("span")];
    const told = element("div", { class: "preparing" }, element("p", { role: "status" }, doing), bar, " ", stage);
    place.prepend(told);
    reveal();
    try {
      await watch(`/v1/jobs/${job.id}/events`, { job: (now) => {
        job = now;
        if (now.progress === null) bar.removeAttribute("value");
        else Object.assign(bar, { max: Math.max(now.progress.total, 1), value: now.progress.done });
        stage.textContent = doingOf(now);
      } });
      job = await read(`/v1/jobs/${job.id}`);
    } finally {
      told.remove();
    }
    if (job.state !== "succeeded") {
      throw new Refusal(409, `${fault}: ${job.error ?? `its job ${job.id} is ${job.state}`}`);
    }
  }
  return job;
}
