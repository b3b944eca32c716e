/** The page of an exported asset. */

import { load, read } from "../api.js";
import { byId } from "../element.js";
import { mountAsset } from "../object/asset.js";

const identifier = byId("main").dataset.identifier;

function name(text) {
  byId("name").textContent = `Asset of ${text}`;
  document.title = `Asset of ${text} · Relit`;
}

await load(async () => {
  byId("job").href = `/jobs/${identifier}`;
  const job = await read(`/v1/jobs/${identifier}`);
  name(job.request.name || identifier);
  await mountAsset(byId("view"), job, name);
});
