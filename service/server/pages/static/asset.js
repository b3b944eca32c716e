/** The page of an exported asset. */

import { attempt, fetched, listing, load, read, resultsOf } from "./api.js";
import { byId, bytes, element, tell } from "./element.js";
import { loadEnvironment, readyEnvironments } from "./environments.js";
import { canRender } from "./view/basis_renderer.js";
import { captureOf, findView } from "./view_jobs.js";

const identifier = byId("main").dataset.identifier;
const SHOWN = /(^|\/)asset\.(usdz|glb)$/;
const LARGE = 100e6; // bytes, which are asked about before they are loaded

/** Return view.json of the capture that a job comes from; null: no view of it is prepared. */
async function rigOf(job) {
  const capture = await captureOf(job);
  const view = capture === null ? null : await findView({ capture });
  return view?.state === "succeeded" ? resultsOf(view.id).json("view.json") : null;
}

async function findAsset() {
  for await (const result of listing(`/v1/jobs/${identifier}/results`, "results", "after")) if (SHOWN.test(result.name)) return result;
  throw new Error("this job has no asset.usdz or asset.glb, which are the formats that this page shows");
}

async function show(job, result) {
  byId("state").textContent = `Loading ${bytes(result.size)} …`;
  const [{ mount }, data, environments, rig] = await Promise.all([import("./view/asset_viewer.js"), fetched(result.url, (answer) => answer.arrayBuffer()),
    readyEnvironments(), rigOf(job).catch((error) => { tell(`The lights of the rig are not shown: ${error.message}`); return null; })]);
  name(job.request.name || rig?.name || identifier);
  globalThis.asset = await mount(byId("view"), { name: result.name.split("/").at(-1), data }, { rig, environments, load: loadEnvironment });
  byId("state").textContent = "";
}

function name(text) {
  byId("name").textContent = `Asset of ${text}`;
  document.title = `Asset of ${text} · Relit`;
}

await load(async () => {
  byId("job").href = `/jobs/${identifier}`;
  const job = await read(`/v1/jobs/${identifier}`);
  name(job.request.name || identifier);
  const result = await findAsset();
  if (!canRender()) {
    byId("state").textContent = "This browser has no WebGL2, which the 3D view needs. The file can be saved on the page of its job, and opened by Blender, usdview or any other program that reads it.";
    return;
  }
  if (result.size <= LARGE) {
    await show(job, result);
    return;
  }
  const button = element("button", { type: "button", onclick: () => { button.remove(); attempt(() => show(job, result)); } }, `Load ${bytes(result.size)}`);
  byId("view").replaceChildren(element("p", {}, `${result.name} is large: a browser needs several times its size as memory. `, button));
});
