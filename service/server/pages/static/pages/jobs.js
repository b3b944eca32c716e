/** The page of all jobs, or of those that are chosen, with the forms of those that begin with neither a capture nor maps. */

import { attempt, load, read } from "../api.js";
import { byId, show } from "../element.js";
import { watch } from "../events.js";
import { enableForms } from "../form.js";
import { newest, once } from "../once.js";
import { JobsTable } from "../jobs_table.js";

const KINDS = Object.keys(JSON.parse(document.body.dataset.titles)); // what people ask for; checks and views have no title
const CHOICES = { "": {}, asked: { kind: KINDS }, active: { state: ["queued", "running"] }, failed: { state: ["failed"] } };
const names = new Map(); // of captures and environments
const choice = byId("which").elements.namedItem("show");
const asked = newest();
let [next, table] = [null, null];

const learnt = Promise.all(["captures", "environments"].map(async (list) => { for (const { id, name } of (await read(`/v1/${list}?limit=500`)).items) names.set(id, name); }));
learnt.catch(() => {}); // whoever waits for it is told

/** Show the newest jobs of those that are chosen. */
async function begin() {
  [table, next] = [new JobsTable(byId("jobs"), () => true, (id) => names.get(id)), null];
  byId("jobs").tBodies[0].replaceChildren();
  await more();
}

async function more() {
  const isNewest = asked();
  const query = new URLSearchParams(Object.entries(CHOICES[choice.value]).flatMap(([name, values]) => values.map((value) => [name, value])));
  if (next !== null) query.set("before", next);
  const [page] = await Promise.all([read(query.size === 0 ? "/v1/jobs" : `/v1/jobs?${query}`), learnt]);
  if (!isNewest()) return;
  page.jobs.forEach((job) => table.put(job));
  next = page.next;
  show(byId("more"), next !== null);
}

/** Show a job as it is now, where it is one of those that are chosen. */
function take(job) {
  const { kind = [job.request.kind], state = [job.state] } = CHOICES[choice.value];
  if (kind.includes(job.request.kind) && state.includes(job.state)) table.put(job);
  else table.drop(job.id);
}

enableForms(byId("work"), "");
choice.value = Object.hasOwn(CHOICES, location.hash.slice(1)) ? location.hash.slice(1) : "";
byId("which").addEventListener("change", () => {
  history.replaceState(null, "", choice.value === "" ? location.pathname : `#${choice.value}`);
  attempt(begin);
});
byId("more").addEventListener("click", () => attempt(() => once(byId("more"), more)));
await load(begin);
await attempt(() => watch("/v1/events", { job: take, gone: ({ id }) => table.drop(id) }));
