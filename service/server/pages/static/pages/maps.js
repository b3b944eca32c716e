/** The page of the maps of a job. */

import { load } from "../api.js";
import { byId } from "../element.js";
import { mountResults, viewOf } from "../object/results.js";

await load(async () => {
  const view = await viewOf(byId("main").dataset.identifier, byId("view"));
  byId("name").textContent = `Maps of ${view.info.name}`;
  document.title = `Maps of ${view.info.name} · Relit`;
  await mountResults(byId("view"), view);
  addEventListener("hashchange", () => location.reload()); // another link to this page was followed
});
