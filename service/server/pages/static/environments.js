/** The environment maps of the server. */

import { fetched, listing } from "./api.js";

/** Return the environments that jobs can take. */
export async function readyEnvironments() {
  const found = [];
  for await (const item of listing("/v1/environments", "items")) if (item.state === "ready") found.push(item);
  return found;
}

/**
 * Return the file of an environment.
 * @param {string} id Identifier.
 * @returns {Promise<{name: string, data: ArrayBuffer}>}
 */
export function loadEnvironment(id) {
  return fetched(`/v1/environments/${id}/file`, async (answer) => {
    const name = /filename="([^"]+)"/.exec(answer.headers.get("Content-Disposition") ?? "")?.[1] ?? id;
    return { name, data: await answer.arrayBuffer() };
  });
}
