/** The step that joins the depth of an object with those of others, taken from other places: their poses are found, then one mesh is fused. */

import { attempt, listing, read, submitJob } from "../api.js";
import { element, show } from "../element.js";
import { once } from "../once.js";

/** Return the newest depth of each other capture, with the name of the capture. */
async function otherDepths(identifier) {
  const newest = new Map();
  for await (const job of listing("/v1/jobs?limit=500&state=succeeded&kind=depth", "jobs")) {
    const { capture } = job.request;
    if (capture !== identifier && !newest.has(capture)) newest.set(capture, job);
  }
  const named = await Promise.all([...newest].map(async ([capture, job]) => {
    try {
      return { job, name: (await read(`/v1/captures/${capture}`)).name };
    } catch (error) {
      if (error.status !== 404) throw error; // the capture was deleted, and its depth is still there
      return { job, name: job.request.name || job.id };
    }
  }));
  return named;
}

/**
 * Offer the step where an object has a depth and there are others, and the second half of it where poses were found already.
 * @param {HTMLDetailsElement} box Takes the chooser.
 * @param {any[]} jobs Of the object, the newest first.
 * @param {function(any): void} submitted Is given each job.
 */
export async function offerFusion(box, identifier, jobs, submitted) {
  const of = (kind) => jobs.find((job) => job.request.kind === kind);
  const [depth, registered, fused] = ["depth", "register", "fuse"].map(of);
  const others = depth === undefined ? [] : await otherDepths(identifier);
  show(box, others.length > 0);
  if (others.length === 0) return;
  const isFused = fused !== undefined && fused.request.registered === registered?.id;
  const choices = others.map(({ job, name }) => element("li", {}, element("label", {}, element("input", { type: "checkbox", value: job.id }), ` ${name}`)));
  const fault = element("p", { class: "fault", role: "alert", hidden: true });
  const form = element("form", { novalidate: true, onsubmit: (event) => {
    event.preventDefault();
    const depths = [depth.id, ...[...form.querySelectorAll(":checked")].map(({ value }) => value)];
    fault.textContent = "Choose at least one other scan.";
    show(fault, depths.length < 2);
    if (depths.length >= 2) attempt(() => once(form, async () => submitted(await submitJob({ kind: "register", depths }))));
  } }, element("p", { class: "help" }, "Choose scans of the same object from other places. Their poses are found first; then one mesh is fused of all."),
  element("ul", { class: "plain" }, ...choices), element("p", { class: "actions" }, element("button", { type: "submit", class: "quiet" }, "Find the poses"),
    registered === undefined || isFused ? null : element("button", { type: "button", onclick: () => attempt(() => once(form, async () => submitted(await submitJob({ kind: "fuse", registered: registered.id })))) },
      "Fuse the registered scans")), fault);
  box.replaceChildren(element("summary", {}, "Fuse with other scans"), form);
  box.open ||= registered !== undefined && !isFused;
}
