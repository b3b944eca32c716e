/** The maps or the depth of a job: their layers, the readings behind each pixel, and the points of a depth. */

import { attempt, read, Refusal, resultsOf } from "../api.js";
import { element } from "../element.js";
import { chosenStep } from "../time_steps.js";
import { mount as mountMaps } from "../view/maps/map_viewer.js";
import { mount as mountPlot } from "../view/maps/pixel_plot.js";
import { ViewFile } from "../view/view_file.js";
import { captureOf, openView } from "../view_jobs.js";

/** Name of jobs that make a preview, which the page of an object leaves out. */
export const PREVIEW = "Preview of the middle";

/** Return the view of the maps of a job, prepared if it is not yet; `place` is where it will be shown. */
export async function viewOf(job, place) {
  const found = await read(`/v1/jobs/${job}`);
  const capture = await captureOf(found);
  const { crop = null } = found.request.options ?? {}; // maps of a part are shown with that part
  const { facts } = await read(`/v1/captures/${capture}`);
  return ViewFile.open((await openView(capture, job, await chosenStep(facts, () => stepNames(job)), place, crop === null ? {} : { options: { crop } })).files);
}

/** Show a view of maps; `others` to compare with, as the viewer of maps takes them. */
export async function mountResults(parent, view, others = []) {
  const [maps, plot] = [element("div"), element("section", { "aria-label": "Readings of a pixel" })];
  parent.replaceChildren(warningsOf(view), maps, plot);
  const readings = mountPlot(plot, view);
  mountMaps(maps, view, { others, onpick: (row, col) => attempt(() => readings?.show(row, col)) });
  if (view.info.points !== null) {
    const points = element("div");
    parent.append(element("section", { "aria-labelledby": "points-title" }, element("h2", { id: "points-title" }, "Points"), points));
    const { mount } = await import("../scene/cloud_viewer.js"); // three.js is large: only a depth needs it here
    globalThis.cloud = await mount(points, view);
  }
}

/** Return what is wrong with a capture, what there is to know of its maps, and what was taken for granted, in words. */
export function warningsOf({ info: { findings, warnings, assumed = [] } }) {
  const list = (kind, sentences) => (sentences.length === 0 ? null : element("ul", { class: `${kind} plain` }, ...sentences.map((each) => element("li", {}, each))));
  const granted = list("assumed", assumed);
  return element("div", {}, list("findings", findings), list("warnings", warnings.filter((each) => !assumed.includes(each))),
    granted === null ? null : element("div", { class: "help" }, "Taken for granted:", granted));
}

/** Return the names of the time steps of a job of a sequence; empty where it is of one capture. */
async function stepNames(job) {
  try {
    return (await resultsOf(job).json("sequence.json")).steps.map((step) => step.path);
  } catch (error) {
    if (error instanceof Refusal && error.status === 404) return [];
    throw error;
  }
}
