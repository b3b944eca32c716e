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

async function more() {
  const page = await read(next === null ? "/v1/jobs" : `/v1/jobs?before=${next}`);
  page.jobs.forEach((job) => table.put(job));
  next = page.next;
  show(byId("more"), next !== null);
}

enableForms(byId("work"), "");
byId("more").addEventListener("click", () => attempt(() => once(byId("more"), more)));
await load(async () => {
  const lists = await Promise.all(["captures", "environments"].map((list) => read(`/v1/${list}?limit=500`)));
  for (const { id, name } of lists.flatMap(({ items }) => items)) names.set(id, name);
  await more();
});
await attempt(() => watch("/v1/events", { job: (job) => table.put(job), gone: ({ id }) => table.drop(id) }));
