/** What the wall shows: captures, sequences, assets and environments, alike whatever list of the API they come from. */

import { listing } from "../api.js";

/**
 * @typedef {{id: string, kind: "capture"|"sequence"|"asset"|"environment", name: string, state: string, problem: string|null, size: string,
 *   created: string, href: string|null, source: any}} Item `source` is the object of the API.
 */

const VIEWED = ["usdz", "glb"]; // formats that the page of assets shows

/** Return the address of the page of a capture: of one that is not ready, the page that says why. */
function pageOf({ id, state }) {
  return state === "ready" ? `/object/${id}` : `/captures/${id}`;
}

/** Return the items of a list of the API. */
export async function itemsOf(list) {
  const found = [];
  if (list === "assets") {
    for await (const job of listing("/v1/jobs?limit=500&state=succeeded&kind=export&kind=pipeline", "jobs")) found.push(assetItem(job));
  } else {
    for await (const intake of listing(`/v1/${list}?limit=500`, "items")) found.push(intakeItem(list, intake));
  }
  return found;
}

/** Return the item of a capture or an environment. */
export function intakeItem(list, intake) {
  const facts = intake.facts ?? {};
  const steps = facts.steps ?? (facts.captures > 1 ? facts.captures : 0);
  const parts = [steps > 0 ? `${steps} time steps` : null, list === "captures" && facts.frames !== undefined ? `${facts.frames} frames` : null,
    facts.resolution === undefined ? null : facts.resolution.join(" × ")];
  return { id: intake.id, kind: list === "environments" ? "environment" : steps > 0 ? "sequence" : "capture", name: intake.name, state: intake.state,
    problem: intake.problem, size: facts.proposal?.summary ?? parts.filter(Boolean).join(" · "), created: intake.created_at,
    href: list === "captures" ? pageOf(intake) : null, source: intake };
}

/** Return the item of a job that has made an asset. */
export function assetItem(job) {
  const { format } = job.request;
  return { id: job.id, kind: "asset", name: job.request.name, state: "ready", problem: null, size: format.toUpperCase(), created: job.created_at,
    href: VIEWED.includes(format) ? `/asset/${job.id}` : `/jobs/${job.id}`, source: job };
}

/**
 * Return the items that a person asks for, in order.
 * @param {Iterable<Item>} items
 * @param {{words: string, kind: string, order: string}} wanted All of the words are in the name or the identifier; no kind: all.
 * @returns {Item[]}
 */
export function chosen(items, { words, kind, order }) {
  const sought = words.toLowerCase().split(/\s+/).filter(Boolean);
  const found = [...items].filter((item) => (kind === "" || item.kind === kind)
    && sought.every((word) => item.name.toLowerCase().includes(word) || item.id.includes(word)));
  const byTime = (one, other) => (one.created < other.created ? -1 : one.created > other.created ? 1 : 0);
  const orders = { newest: (one, other) => byTime(other, one), oldest: byTime, name: (one, other) => one.name.localeCompare(other.name, undefined, { numeric: true }) };
  return found.sort(orders[order]);
}
