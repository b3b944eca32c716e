/** An exported asset in 3D, with the lights of the rig that it was captured under. */

import { attempt, fetched, listing, resultsOf } from "../api.js";
import { bytes, element, tell } from "../element.js";
import { loadEnvironment, readyEnvironments } from "../environments.js";
import { showPoster } from "../scene/poster.js";
import { canRender } from "../view/light/basis_renderer.js";
import { cardOf } from "../view/view_file.js";
import { captureOf, findView } from "../view_jobs.js";

const SHOWN = /(^|\/)asset\.(usdz|glb)$/;
const LARGE = 100e6; // bytes, which are asked about before they are loaded

/** Return the files of a view of the capture that a job comes from; null: none is prepared. */
async function viewOf(job) {
  const capture = await captureOf(job);
  const view = capture === null ? null : await findView({ capture });
  return view?.state === "succeeded" ? resultsOf(view.id) : null;
}

async function findAsset(job) {
  for await (const result of listing(`/v1/jobs/${job.id}/results`, "results", "after")) if (SHOWN.test(result.name)) return result;
  throw new Error("this job has no asset.usdz or asset.glb, which are the formats that this page shows");
}

/**
 * Show the asset of a job.
 * @param {HTMLElement} parent Takes it.
 * @param {any} job As the API gives it.
 * @param {function(string): void} [named] Told the name of the asset.
 */
export async function mountAsset(parent, job, named = () => {}) {
  const view = viewOf(job);
  const rig = view.then((files) => files?.json("view.json") ?? null)
    .catch((error) => { tell(`The lights of the rig are not shown: ${error.message}`); return null; });
  const poster = view.then((files) => (files === null ? null : cardOf(files))).catch(() => null);
  const result = await findAsset(job);
  const canvas = element("canvas", { class: "scene" });
  const panel = element("div", { class: "panel" });
  parent.replaceChildren(element("div", { class: "viewer" }, element("div", { class: "stage" }, canvas), panel));
  const show = async () => {
    panel.replaceChildren(element("p", { role: "status" }, `Loading ${bytes(result.size)} …`));
    const data = fetched(result.url, (answer) => answer.arrayBuffer());
    data.catch(() => {}); // whoever waits for it is told
    const picture = await poster;
    if (picture !== null) await showPoster(canvas, picture); // before the graphics processor is waited for
    if (!canRender()) {
      parent.replaceChildren(element("p", { class: "fault" }, "This browser has no WebGL2, which the 3D view needs. The file can be saved on the page of its job, and opened by Blender, usdview or any other program that reads it."));
      return;
    }
    const { mount } = await import("../scene/asset_viewer.js");
    const [environments, lights] = await Promise.all([readyEnvironments(), rig]);
    named(job.request.name || lights?.name || job.id);
    globalThis.asset = await mount(parent, { name: result.name.split("/").at(-1), data: await data }, { rig: lights, environments, load: loadEnvironment, poster: picture });
  };
  if (result.size <= LARGE) {
    await show();
    return;
  }
  const button = element("button", { type: "button", onclick: () => attempt(show) }, `Load ${bytes(result.size)}`);
  panel.replaceChildren(element("p", {}, `${result.name} is large: a browser needs several times its size as memory. `, button));
}
