/** The first page: the capture that was prepared last, to be lit; without one, the captures. */

import { attempt } from "./api.js";
import { byId } from "./element.js";
import { findView } from "./view_jobs.js";

await attempt(async () => {
  const view = await findView({ step: null });
  location.replace(view === null ? "/captures" : `/light/${view.request.capture}`);
  byId("state").textContent = "Opening …";
});
