/** What is made of a capture that is whole: one of the service's captures, a picture whose light moves, maps and an asset. */

import { attempt, listing, newToken, post, read, Refusal, submitJob } from "../api.js";
import { byId, show, tell } from "../element.js";
import { watch } from "../events.js";
import { progressOf } from "../jobs_table.js";
import { openView } from "../view_jobs.js";
import { showPicture } from "./picture.js";
import { mountTurning } from "./turning.js";

const CHECK_MS = 300;

/**
 * Return what follows the last picture.
 * @param {string[]} patterns Names of the plans of patterns, which are decoded instead of solved.
 * @param {function(): void} changed Called when `outcome` has changed.
 */
export function mountOutcome(patterns, changed) {
  const outcome = { solvable: false, patterns: false, busy: false, solved: false, asset: null };
  let version = null;
  let capture = null;
  let solved = null;
  let kind = "solve";
  let viewer = null;

  function set(values) {
    Object.assign(outcome, values);
    changed();
  }

  /** Do something with the capture as it is now; a refusal is told only if it still is. */
  async function begin(state) {
    const now = version;
    const current = () => version === now;
    byId("state").textContent = "The service looks at the capture …";
    capture = await registered(state);
    if (!current()) return;
    if (capture.state !== "ready") {
      byId("state").textContent = capture.problem;
      return;
    }
    byId("state").textContent = "";
    byId("light-page").href = `/light/${capture.id}`;
    byId("capture-page").href = `/captures/${capture.id}`;
    show(byId("light-page"), kind === "solve");
    show(byId("pages"), true);
    await found(current);
    if (!current()) return;
    set({ solvable: true });
    if (kind === "solve") await present(current);
  }

  /** Find the jobs of the capture that an earlier look at this page has started. */
  async function found(current) {
    const jobs = [];
    for await (const job of listing("/v1/jobs?limit=500&state=succeeded&state=queued&state=running", "jobs")) jobs.push(job);
    const made = jobs.find(({ request }) => request.kind === kind && request.capture === capture.id);
    if (made === undefined || !current()) return;
    const asset = jobs.find(({ request }) => request.kind === "export" && request.maps === made.id);
    work(async () => {
      await finish(made);
      if (asset !== undefined) await finish(asset);
    });
  }

  /** Show the capture under a light that moves; it replaces the preview. */
  async function present(current) {
    const { files } = await openView(capture.id, null, null, byId("turning"));
    const made = current() ? await mountTurning(byId("turning"), files) : null;
    if (made === null) return;
    if (!current()) {
      made.destroy();
      return;
    }
    viewer = made;
    show(byId("moving"), true);
    show(byId("preview"), false);
  }

  /** Follow a job to its end, and show what it made. */
  async function finish(job) {
    const now = version;
    let last = job;
    const say = () => { if (version === now) byId("jobs").textContent = `${last.request.kind}: ${progressOf(last) || last.state}`; };
    say();
    if (last.state !== "succeeded") await watch(`/v1/jobs/${job.id}/events`, { job: (each) => { last = each; say(); } });
    last = await read(`/v1/jobs/${job.id}`);
    if (version !== now) return null;
    if (last.state !== "succeeded") throw new Error(`${last.request.kind}: ${last.error ?? last.state}`);
    byId("jobs").textContent = "";
    if (last.request.kind === "export") {
      byId("asset").href = `/asset/${last.id}`;
      set({ asset: last.id });
    } else {
      solved = last;
      byId("maps-page").href = `/maps/${last.id}`;
      show(byId("maps-page"), true);
      set({ solved: true });
    }
    return last;
  }

  async function work(action) {
    set({ busy: true });
    try {
      await action();
    } catch (error) {
      byId("jobs").textContent = "";
      tell(error.message);
    } finally {
      set({ busy: false });
    }
  }

  const submit = (request) => submitJob(request).then(finish);
  const solve = async () => solved ?? submit({ kind, capture: capture.id });
  byId("solve").addEventListener("click", () => work(solve));
  byId("export").addEventListener("click", () => work(async () => {
    const maps = await solve();
    if (maps !== null) await submit({ kind: "export", maps: maps.id });
  }));

  return {
    outcome,
    follow(state) {
      const preview = state.files["preview.png"];
      show(byId("result"), preview !== undefined || (state.version !== null && state.shots.some((shot) => shot.step === "object")));
      if (preview !== undefined && byId("preview").dataset.changed !== `${state.name} ${preview}`) {
        showPicture(byId("preview"), `/set/files/preview.png?at=${preview}`);
        byId("preview").dataset.changed = `${state.name} ${preview}`;
      }
      const now = state.version === null ? null : `${state.name} ${state.version}`;
      if (now === version) return;
      version = now;
      viewer?.destroy();
      viewer = capture = solved = null;
      kind = state.chosen.plan.split(",").some((word) => patterns.includes(word)) ? "depth" : "solve";
      byId("turning").replaceChildren();
      byId("state").textContent = byId("jobs").textContent = "";
      show(byId("preview"), preview !== undefined);
      for (const id of ["pages", "maps-page", "moving"]) show(byId(id), false);
      Object.assign(outcome, { solvable: false, patterns: kind === "depth", solved: false, asset: null });
      if (now !== null && state.shots.some((shot) => shot.step === "object")) attempt(() => begin(state));
    },
  };
}

/** Return the capture of the service for a capture of the set, which is registered once for each state of its pictures, when it is checked. */
async function registered({ name, folder, version }) {
  const add = (token) => post("/v1/captures", { name, folder }, { "Idempotency-Key": token });
  let capture = await add(`set-${name}-${version}`).catch((error) => {
    if (error instanceof Refusal && error.status === 404) return add(newToken()); // a person has deleted it
    throw error;
  });
  while (capture.state === "checking") {
    await new Promise((resolve) => { setTimeout(resolve, CHECK_MS); });
    capture = await read(`/v1/captures/${capture.id}`);
  }
  return capture;
}
