/** The page that lights a capture live. */

import { load } from "../api.js";
import { byId } from "../element.js";
import { readyEnvironments } from "../environments.js";
import { mountLight } from "../object/light.js";
import { ViewFile } from "../view/view_file.js";
import { openView } from "../view_jobs.js";

const identifier = byId("main").dataset.identifier;

await load(async () => {
  const [view, environments] = await Promise.all([openView(identifier, null, null, byId("view")).then(({ files }) => ViewFile.open(files)), readyEnvironments()]);
  byId("name").textContent = view.info.name;
  document.title = `${view.info.name} · Relit`;
  await mountLight(byId("view"), identifier, view, environments);
  addEventListener("hashchange", () => location.reload()); // another link to this page was followed
});
