/** What a job was asked for, in the words of the form of its kind. */

import { read, Refusal } from "../api.js";
import { element, words } from "../element.js";

const LISTS = { cap: "captures", env: "environments" }; // by what identifiers begin with

/** Return rows of a list of facts: what was chosen, and what is as it is by default. */
export async function requestRows(job) {
  const valueAt = (path) => path.split(".").reduce((value, name) => value?.[name], job.request) ?? "";
  const given = [[], []]; // chosen, and as it is by default
  if (job.request.name) given[0].push(["Name", job.request.name]);
  for (const { paths, label, default: usual } of await formWords(job.request.kind)) {
    const value = valueAt(paths[0]);
    if (value === "" || value.length === 0 || (label === "Name" && paths[0] === "name")) continue;
    const isUsual = valueText(value) === usual || (value === false && usual === "");
    given[Number(isUsual)].push([label, value]);
  }
  const intakes = given.flat().flatMap(([, value]) => value).filter((value) => /^(cap|env)_/.test(value));
  const named = new Map(await Promise.all(intakes.map(async (id) => [id, await read(`/v1/${LISTS[id.slice(0, 3)]}/${id}`).then(({ name }) => name, () => id)]))); // it may be deleted
  const [chosen, usual] = given.map((rows) => rows.flatMap(([label, value]) => [element("dt", {}, label),
    element("dd", {}, ...[value].flat().flatMap((each, at) => [at > 0 ? ", " : "", link(each, named)]))]));
  return { chosen, usual };
}

/** Return how the form of a kind names its fields; jobs that the service makes on its own have no form, and their fields are named by themselves. */
async function formWords(kind) {
  try {
    return await read(`/forms/${kind}`);
  } catch (error) {
    if (!(error instanceof Refusal && error.status === 422)) throw error;
    return ["capture", "maps", "intake"].map((name) => ({ paths: [name], label: words(name), default: "" }));
  }
}

/** Return a value of a request as a person reads it: a document by its name, or by how much it holds. */
function valueText(value) {
  if (typeof value === "boolean") return value ? "true" : "";
  if (typeof value !== "object") return String(value);
  if (Array.isArray(value)) return value.map(valueText).join(",");
  return value.name ?? value.schema ?? `${Object.keys(value).length} values`;
}

function link(value, named) {
  if (/^cap_/.test(value)) return element("a", { href: `/captures/${value}` }, named.get(value));
  if (/^job_/.test(value)) return element("a", { href: `/jobs/${value}` }, value);
  return typeof value === "boolean" ? (value ? "yes" : "no") : named.get(value) ?? valueText(value);
}
