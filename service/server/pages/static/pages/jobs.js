/** The page of all jobs, with the forms of those that begin with neither a capture nor maps. */

import { attempt, load, read } from "../api.js";
import { byId, show } from "../element.js";
import { watch } from "../events.js";
import { enableForms } from "../form.js";
import { once } from "../once.js";
import { JobsTable } from "../jobs_table.js";

const table = new JobsTable(byId("jobs"));
let next = null;

async function more() {
  const page = await read(next === null ? "/v1/jobs" : `/v1/jobs?before=${next}`);
  page.jobs.forEach((job) => table.put(job));
  next = page.next;
  show(byId("more"), next !== null);
}

enableForms(byId("work"), "");
byId("more").addEventListener("click", () => attempt(() => once(byId("more"), more)));
await load(more);
await attempt(() => watch("/v1/events", { job: (job) => table.put(job), gone: ({ id }) => table.drop(id) }));
