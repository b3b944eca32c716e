/** The first page: the capture that was prepared last, to be lit; without one, the captures. */

import { load } from "./api.js";
import { byId } from "./element.js";
import { findView } from "./view_jobs.js";

await load(async () => {
  const view = await findView({ step: null });
  location.replace(view === null ? "/captures" : `/light/${view.request.capture}`);
  byId("state").textContent = "Opening …";
});
