/** The page of all jobs, with the forms of those that begin with neither a capture nor maps. */

import { attempt, load, read } from "../api.js";
import { byId, show } from "../element.js";
import { watch } from "../events.js";
import { enableForms } from "../form.js";
import { once } from "../once.js";
import { JobsTable } from "../jobs_table.js";

const names = new Map(); // of captures and environments
const table = new JobsTable(byId("jobs"), () => true, (id) => names.get(id));
let next = null;

async function learnNames(list) {
  for (const { id, name } of (await read(`/v1/${list}?limit=500`)).items) names.set(id, name);
}

async function more() {
  const [page] = await Promise.all([read(next === null ? "/v1/jobs" : `/v1/jobs?before=${next}`), ...(next === null ? ["captures", "environments"].map(learnNames) : [])]);
  page.jobs.forEach((job) => table.put(job));
  next = page.next;
  show(byId("more"), next !== null);
}

enableForms(byId("work"), "");
byId("more").addEventListener("click", () => attempt(() => once(byId("more"), more)));
await load(more);
await attempt(() => watch("/v1/events", { job: (job) => table.put(job), gone: ({ id }) => table.drop(id) }));
