/** The page of the maps of a job: their layers, and the readings behind each pixel. */

import { attempt, load, read, Refusal, resultsOf } from "./api.js";
import { byId, element } from "./element.js";
import { mount as mountMaps } from "./view/map_viewer.js";
import { mount as mountPlot } from "./view/pixel_plot.js";
import { chosenStep } from "./time_steps.js";
import { ViewFile } from "./view/view_file.js";
import { captureOf, openView } from "./view_jobs.js";

const identifier = byId("main").dataset.identifier;

/** Return the names of the time steps of a job of a sequence; empty where it is of one capture. */
async function stepNames() {
  try {
    return (await resultsOf(identifier).json("sequence.json")).steps.map((step) => step.path);
  } catch (error) {
    if (error instanceof Refusal && error.status === 404) return [];
    throw error;
  }
}

await load(async () => {
  const job = await read(`/v1/jobs/${identifier}`);
  const capture = await captureOf(job);
  const { files } = await openView(capture, identifier, await chosenStep(capture, await stepNames()));
  const view = await ViewFile.open(files);
  byId("name").textContent = `Maps of ${view.info.name}`;
  document.title = `Maps of ${view.info.name} · Relit`;
  const [maps, plot] = [element("div"), element("section", { "aria-label": "Readings of a pixel" })];
  byId("view").replaceChildren(maps, plot);
  const readings = mountPlot(plot, view);
  mountMaps(maps, view, { onpick: (row, col) => attempt(() => readings?.show(row, col)) });
  if (view.info.points !== null) {
    const points = element("div");
    byId("view").append(element("section", { "aria-labelledby": "points-title" }, element("h2", { id: "points-title" }, "Points"), points));
    const { mount } = await import("./view/cloud_viewer.js"); // three.js is large: only a depth needs it here
    globalThis.cloud = await mount(points, view);
  }
});
