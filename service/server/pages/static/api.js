/** Requests to the API of this server, with the key of the person who looks. */

import { byId, element, show, tell } from "./element.js";
import { showFaultPage } from "./fault_page.js";
import { reloadWhenBack, repeated } from "./repeat.js";

const KEY = "relit-key";
const UNREACHABLE = "The server cannot be reached. Nothing that it has acknowledged is lost.";
const PASSING = [0, 429, 502, 503, 504]; // statuses of what may succeed soon
let asking = null;
let loading = 0; // what the page shows at first, and is not here yet

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

/**
 * Ask for something until all of it is here: a lost connection, a server that is restarted and an answer that breaks off are tried again.
 * @param {string} path Of this server.
 * @param {function(Response): Promise<any>} take Reads the body, and throws where it is not whole.
 * @param {Object<string, string>} [headers] Of the request.
 */
export function fetched(path, take, headers = {}) {
  return repeated(async (failed) => {
    const answer = await send(path, { headers, cache: failed === 0 ? "no-cache" : "no-store" }); // what a browser has kept may be the fault
    try {
      return await take(answer);
    } catch (error) {
      throw new Refusal(0, `${path} broke off: ${error.message}`);
    }
  }, mayPass);
}

function mayPass(error) {
  return error instanceof Refusal && PASSING.includes(error.status);
}

/** Return the JSON that a path gives. */
export function read(path) {
  return fetched(path, (answer) => answer.json());
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

/** Create something once, however often its request has to be sent, and return it. */
export function postOnce(path, body, token = newToken()) {
  return repeated(() => post(path, body, { "Idempotency-Key": token }), mayPass);
}

/** Submit a job and return it. */
export function submitJob(request) {
  return postOnce("/v1/jobs", request);
}

/** Delete what is at a path. */
export async function remove(path) {
  await send(path, { method: "DELETE" });
}

/** Return the warnings among the entries of the log of a job. */
export function warningsIn(entries) {
  const begin = "warning: ";
  return entries.filter(({ text }) => text.startsWith(begin)).map(({ text }) => text.slice(begin.length));
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
      return fetched(at(name), async (answer) => {
        const found = await answer.arrayBuffer(); // going Back, Chromium gives parts from its cache that have their length in the header and no bytes
        if (length !== undefined && found.byteLength !== length) throw new Error(`${found.byteLength} of ${length} bytes came`);
        return found;
      }, headers);
    },
  };
}

/** Save a file of this server with the key of this tab, which a plain link would not send. */
export async function save(path) {
  const address = URL.createObjectURL(await fetched(path, (answer) => answer.blob()));
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

/**
 * Run what a page does, and tell the person why where it fails, with a button that tries again where that may help.
 * @param {function(): Promise<any>} action
 * @param {{again?: function(): void, onaway?: function(): void}} [options] What the button does; `onaway` is called where the server is away.
 */
export async function attempt(action, { again = () => attempt(action), onaway = () => {} } = {}) {
  try {
    return await action();
  } catch (error) {
    const isAway = error.status === 0 || /import/i.test(error.message); // a page does not ask again for a module that was lost
    const passes = isAway || error.status === 429 || error.status >= 500;
    if (!(error instanceof Refusal || isAway)) console.error(error);
    if (isAboutThePage(error)) showFaultPage(error.message);
    else tell(error instanceof Refusal ? error.message : isAway ? UNREACHABLE : `This page failed: ${error.message}`, "fault", passes ? again : null);
    if (isAway) onaway();
    return undefined;
  }
}

/**
 * Load what a page shows: where the server is away for long, the page is loaded again when it is back. Until all is here, what would move is not shown.
 * @param {function(): Promise<void>} action
 */
export async function load(action) {
  loading += 1;
  try {
    return await attempt(action, { again: reloadWhenBack, onaway: reloadWhenBack });
  } finally {
    loading -= 1;
    if (loading === 0) reveal();
  }
}

/** Show what is here of a page, which may move as the rest comes. */
export function reveal() {
  byId("main").removeAttribute("aria-busy");
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
document.querySelector(".skip").addEventListener("click", (event) => {
  event.preventDefault(); // the address says what is shown, and keeps it
  byId("main").focus();
});
byId("stuck").remove(); // all modules of the page are here
