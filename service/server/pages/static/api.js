/** Requests to the API of this server, with the key of the person who looks. */

import { byId, element, show, tell } from "./element.js";
import { showFaultPage } from "./fault_page.js";

const KEY = "relit-key";
const UNREACHABLE = "The server cannot be reached. Nothing that it has acknowledged is lost.";
let asking = null;
let loading = 0; // actions under way

/** A request that the server refused, with its sentence. */
export class Refusal extends Error {
  /**
   * @param {number} status HTTP status; 0: the server cannot be reached.
   * @param {string} sentence For a person.
   */
  constructor(status, sentence) {
    super(sentence);
    this.status = status;
  }
}

/** Return the headers that carry the key, if there is one. */
export function credentials() {
  const key = sessionStorage.getItem(KEY);
  return key === null ? {} : { Authorization: `Bearer ${key}` };
}

/** Return whether requests carry a key. */
export function hasKey() {
  return sessionStorage.getItem(KEY) !== null;
}

/**
 * Send a request, and ask for a key where the server wants one.
 * @param {string} path Of this server.
 * @param {RequestInit} [options] As fetch takes them.
 * @returns {Promise<Response>} The answer, whose status is below 400.
 */
export async function send(path, options = {}) {
  const key = sessionStorage.getItem(KEY);
  let answer;
  try {
    answer = await fetch(path, { ...options, headers: { ...credentials(), ...options.headers }, redirect: "error" });
  } catch (error) {
    if (error.name === "AbortError") throw error;
    throw new Refusal(0, UNREACHABLE);
  }
  if (answer.ok) return answer;
  const refused = await refusal(answer);
  if (refused.status !== 401) throw refused;
  const isNew = sessionStorage.getItem(KEY) !== key; // another request has asked for it meanwhile
  if (isNew || (await askForKey(key === null ? "" : refused.message))) return send(path, options);
  throw refused;
}

/** Return the refusal of an answer, with the sentence of its problem document. */
export async function refusal(answer) {
  let sentence = `${answer.status} ${answer.statusText}`;
  try {
    const problem = await answer.json();
    sentence = problem.detail ?? problem.title ?? sentence;
  } catch {
    // an answer of something between: its status must do
  }
  return new Refusal(answer.status, sentence);
}

/** Return the JSON that a path gives. */
export async function read(path) {
  return (await send(path)).json();
}

/** Send JSON and return the JSON of the answer; null where it has none. */
export async function post(path, body = undefined, headers = {}) {
  const answer = await send(path, body === undefined ? { method: "POST", headers } : {
    method: "POST", headers: { "Content-Type": "application/json", ...headers }, body: JSON.stringify(body) });
  return answer.status === 204 ? null : answer.json();
}

/** Return an Idempotency-Key: a request that is sent again with it creates nothing again. */
export function newToken() {
  return crypto.getRandomValues(new Uint32Array(4)).join("-");
}

/** Delete what is at a path. */
export async function remove(path) {
  await send(path, { method: "DELETE" });
}

/**
 * Return the files of a job's results as a view reads them.
 * @param {string} job Identifier.
 * @returns {{json: function(string): Promise<any>, bytes: function(string, number=, number=): Promise<ArrayBuffer>}}
 */
export function resultsOf(job) {
  const at = (name) => `/v1/jobs/${job}/results/${name.split("/").map(encodeURIComponent).join("/")}`;
  return {
    json: (name) => read(at(name)),
    bytes: async (name, offset = undefined, length = undefined) => {
      if (length === 0) return new ArrayBuffer(0);
      const headers = offset === undefined ? {} : { Range: `bytes=${offset}-${offset + length - 1}` };
      return (await send(at(name), { headers })).arrayBuffer();
    },
  };
}

/** Save a file of this server with the key of this tab, which a plain link would not send. */
export async function save(path) {
  const address = URL.createObjectURL(await (await send(path)).blob());
  element("a", { href: address, download: path.split("/").at(-1) }).click();
  setTimeout(() => URL.revokeObjectURL(address), 60_000);
}

/**
 * Yield all items of a listing, page by page.
 * @param {string} path Of the listing, with its query.
 * @param {string} field Name of the list in a page.
 * @param {string} [cursor] Name of the parameter that takes `next`.
 */
export async function* listing(path, field, cursor = "before") {
  let next = null;
  do {
    const url = new URL(path, location.origin);
    if (next !== null) url.searchParams.set(cursor, next);
    const page = await read(url.pathname + url.search);
    yield* page[field];
    next = page.next;
  } while (next !== null);
}

/** Run what a page does, and tell the person why where it fails, with a button that tries again where that may help. */
export async function attempt(action) {
  loading += 1;
  try {
    return await action();
  } catch (error) {
    if (!(error instanceof Refusal)) console.error(error);
    const passes = error instanceof Refusal && (error.status === 0 || error.status === 429 || error.status >= 500);
    if (isAboutThePage(error)) showFaultPage(error.message);
    else tell(error instanceof Refusal ? error.message : `This page failed: ${error.message}`, "fault", passes ? () => attempt(action) : null);
    return undefined;
  } finally {
    loading -= 1;
    if (loading === 0) byId("main").removeAttribute("aria-busy");
  }
}

/** Return whether an error says that the capture or job that the page shows does not exist. */
function isAboutThePage(error) {
  const { identifier } = byId("main").dataset;
  return identifier !== undefined && error instanceof Refusal && error.status === 404 && error.message.includes(identifier);
}

/** Show the dialog for a key, once however many requests wait for it; return whether one was given. `fault` says what is wrong with the last. */
function askForKey(fault = "") {
  asking ??= new Promise((resolve) => {
    const dialog = byId("key-dialog");
    const value = byId("key-value");
    value.value = "";
    byId("key-fault").textContent = fault;
    show(byId("key-fault"), fault !== "");
    dialog.addEventListener("close", () => {
      asking = null;
      const given = dialog.returnValue === "save" && value.value.trim() !== "";
      if (given) sessionStorage.setItem(KEY, value.value.trim());
      value.value = "";
      resolve(given);
    }, { once: true });
    dialog.returnValue = "";
    dialog.showModal();
  });
  return asking;
}

byId("key").addEventListener("click", async () => {
  if (await askForKey()) location.reload();
});
