/** The report of a job in words: its facts by name, without what the page says elsewhere or only programs read. */

import { duration, element, words } from "../element.js";

const LEFT_OUT = ["schema", "inputs", "options", "warnings", "versions"]; // the request, the warnings above the maps, and what reproduces a run
const MOST_VALUES = 4; // of a list that is written out
const COUNTED = "pixels"; // of which what is 0 says nothing

/** Return the report as lists of facts. */
export function reportWords(report) {
  const facts = Object.entries(report).filter(([name]) => !LEFT_OUT.includes(name));
  const [plain, parts] = [facts.filter(([, value]) => !isPart(value)), facts.filter(([, value]) => isPart(value))];
  return [rows(plain, ""), ...parts.flatMap(([name, value]) => {
    const list = rows(Object.entries(value), name);
    return list.children.length === 0 ? [] : [element("h3", {}, name === "timings_s" ? "Time taken" : words(name)), list];
  })];
}

function isPart(value) {
  return typeof value === "object" && value !== null && !Array.isArray(value);
}

function rows(facts, part) {
  const told = facts.filter(([, value]) => value !== null && !(part === COUNTED && value === 0) && !(Array.isArray(value) && value.length === 0));
  return element("dl", {}, ...told.flatMap(([name, value]) => [element("dt", {}, words(name)), element("dd", {}, part === "timings_s" ? duration(value) : text(value))]));
}

function text(value) {
  if (typeof value === "boolean") return value ? "yes" : "no";
  if (typeof value === "number") return Number.isInteger(value) ? value.toLocaleString() : String(Number(value.toPrecision(3)));
  if (Array.isArray(value)) return value.length > MOST_VALUES ? `${value.length} values` : value.map(text).join(", ");
  if (isPart(value)) return Object.entries(value).map(([name, each]) => `${words(name).toLowerCase()}: ${text(each)}`).join("; ");
  return String(value);
}
