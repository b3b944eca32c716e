/** What jobs have made of an object: the newest file of each name, the report in words, and what was asked for. */

import { attempt, listing, resultsOf, save } from "../api.js";
import { bytes, element, kindTitle } from "../element.js";
import { newest } from "../once.js";
import { reportWords } from "./report.js";
import { requestRows } from "./request.js";

const asked = newest();
const SAVED = /(^|\/)(asset\.(usdz|usda|usdc|glb)|maps\.exr|depth\.exr|points\.ply|mesh\.ply|report\.json|annotations\.json|basis\.(exr|ptm|rti)|separation\.exr)$/;

/** Return the newest file of each name that jobs, the newest first, have made: name, job and result of each. */
export async function newestFiles(jobs) {
  const found = new Map();
  for (const job of jobs) {
    for await (const result of listing(`/v1/jobs/${job.id}/results`, "results", "after")) {
      const name = result.name.split("/").at(-1);
      if (SAVED.test(result.name) && !found.has(name)) found.set(name, { name, job, result });
    }
  }
  return [...found.values()];
}

/** Return a link that saves a file of the server. */
export function savingLink({ name, result }, text = name, more = {}) {
  return element("a", { href: result.url, ...more, onclick: (event) => { event.preventDefault(); attempt(() => save(result.url)); } }, text);
}

/** Show files in a list. */
export function presentFiles(list, files) {
  list.replaceChildren(...files.map((file) => element("li", {}, savingLink(file), ` ${bytes(file.result.size)}`)));
}

/** Show the report of the newest job that has one, and its request, when they are unfolded. */
export function presentReport(details, files) {
  const file = files.find(({ name }) => name === "report.json");
  details.hidden = file === undefined;
  details.querySelector("div").replaceChildren();
  if (file === undefined) return;
  const { job, result } = file;
  const isNewest = asked();
  const open = () => details.open && attempt(async () => {
    const [report, { chosen, usual }] = await Promise.all([resultsOf(job.id).json(result.name), requestRows(job)]);
    if (isNewest()) details.querySelector("div").replaceChildren(element("h3", {}, kindTitle(job.request.kind)), element("dl", {}, ...chosen),
      element("details", {}, element("summary", {}, "All else is as it is by default"), element("dl", {}, ...usual)), ...reportWords(report));
  });
  details.ontoggle = open;
  open();
}
