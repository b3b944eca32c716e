/** Uploads of captures and environments by tus 1.0 (https://tus.io/protocols/resumable-upload), continued after an interruption. */

import { listing, newToken, post, read, Refusal, send } from "../api.js";

const PIECE_BYTES = 8 << 20;
const PARALLEL = 4;
const DIGEST_BYTES = 256 << 20; // a larger file would have to be in memory as a whole to be hashed
const LONGEST_WAIT_S = 15;
const TUS = { "Tus-Resumable": "1.0.0" };

/** A file with its path within the capture. @typedef {{path: string, file: File}} LocalFile */
/** What stops an upload, whereupon the server keeps what it has; and who is told that the server cannot be reached, or can again.
 * @typedef {{signal: AbortSignal, lost: function(boolean): void}} Link */

/** Thrown where an upload was stopped by the person. */
export class Stopped extends Error {}

/**
 * Upload the files of a capture or environment, and have them checked, or guessed where they are no capture yet.
 *
 * An upload of the same name that was interrupted is continued: files that the server has are not sent again. Files to be guessed that the
 * server has as a capture of this name are that capture.
 * @param {"captures"|"environments"} listingName What is created.
 * @param {string} name Of the capture.
 * @param {LocalFile[]} files All of them.
 * @param {function(number, number, string): void} progress Told bytes sent, bytes in all, and what is being done.
 * @param {Link} link
 * @param {"validate"|"guess"} then What is done with the files.
 * @returns {Promise<any>} The capture: ready or refused, or receiving with the fact `proposal`.
 */
export async function upload(listingName, name, files, progress, link, then = "validate") {
  const [intake, known] = await begun(listingName, name, then === "guess" ? files : null);
  if (intake.state === "ready" || intake.state === "checking") return settled(intake, listingName, link);
  const total = files.reduce((sum, { file }) => sum + file.size, 0);
  const sent = new Map();
  let over = false; // one file failed, or the person stopped: the others end too, and tell nothing any more
  const tell = (path, bytes) => {
    if (over) return;
    sent.set(path, bytes);
    progress([...sent.values()].reduce((sum, each) => sum + each, 0), total, "uploading");
  };
  const waiting = [...files];
  const one = async () => {
    for (let next = waiting.shift(); next !== undefined && !over; next = waiting.shift()) {
      await uploadFile(`/v1/${listingName}/${intake.id}/files`, next, known.get(next.path), (bytes) => tell(next.path, bytes), link);
    }
  };
  try {
    await Promise.all(Array.from({ length: PARALLEL }, one));
  } finally {
    over = true;
  }
  progress(total, total, "checking");
  return settled(await asked(`/v1/${listingName}/${intake.id}`, then, link), listingName, link);
}

/** Ask for a look at the files; an answer that was lost with the connection is asked for again. */
async function asked(place, then, link) {
  try {
    return await persist(() => post(`${place}/${then}`), link);
  } catch (error) {
    const found = error instanceof Refusal && error.status === 409 ? await persist(() => read(place), link) : null;
    if (found === null || found.state === "receiving") throw error;
    return found;
  }
}

/** Return a capture or environment when nothing looks at it any more. */
export async function settled(found, listingName, link) {
  while (found.state === "checking") {
    await pause(0.5, link.signal);
    found = await persist(() => read(`/v1/${listingName}/${found.id}`), link);
  }
  return found;
}

/** Return a capture or environment of this name that can take the files, a new one if there is none, and the files that it has; with
 * `same`, one that has nothing else than these files, or that was made of them. */
async function begun(listingName, name, same) {
  for await (const intake of listing(`/v1/${listingName}`, "items")) {
    if (intake.name !== name || intake.registered) continue;
    if (same === null && intake.state !== "receiving") continue;
    const known = new Map();
    for await (const file of listing(`/v1/${listingName}/${intake.id}/files`, "files", "after")) known.set(file.path, file);
    if (same === null || (await isOf(intake, known, same))) return [intake, known];
  }
  return [await post(`/v1/${listingName}`, { name }), new Map()];
}

async function isOf(intake, known, files) {
  if (intake.state === "receiving" || intake.state === "refused") {
    const sizes = new Map(files.map(({ path, file }) => [path, file.size]));
    return [...known.values()].every(({ path, length }) => sizes.get(path) === length);
  }
  if (!files.every(({ path, file }) => known.get(path)?.length === file.size)) return false;
  for (const { path, file } of files) {
    if (!(await isStored(known.get(path), file))) return false;
  }
  return true;
}

/** Return whether the server has a file whole; one too large for a digest is told by its length. */
async function isStored(known, file, digest = undefined) {
  if (!known?.done || known.length !== file.size) return false;
  const ours = digest === undefined ? await digestOf(file) : digest;
  return ours === null || known.sha256 === hex(ours);
}

async function digestOf(file) {
  return file.size <= DIGEST_BYTES ? sha256(await file.arrayBuffer()) : null;
}

async function uploadFile(place, { path, file }, known, progress, link) {
  const digest = await digestOf(file);
  if (await isStored(known, file, digest)) {
    progress(file.size);
    return;
  }
  let target = known !== undefined && !known.done && known.length === file.size ? `/v1/uploads/${known.upload}` : null;
  if (target === null) {
    if (known !== undefined && !known.done) await send(`/v1/uploads/${known.upload}`, { method: "DELETE", headers: TUS });
    target = await create(place, path, file.size, digest, link);
  }
  let offset = await persist(() => offsetOf(target), link);
  while (offset < file.size) {
    progress(offset);
    const piece = await file.slice(offset, offset + PIECE_BYTES).arrayBuffer();
    try {
      offset = await patch(target, offset, piece, link.signal);
    } catch (error) {
      if (!(error instanceof Refusal) || ![0, 409, 423, 429, 460, 503].includes(error.status)) throw error;
      await pause(1, link.signal);
      offset = await persist(() => offsetOf(target), link);
    }
  }
  progress(file.size);
}

async function create(place, path, size, digest, link) {
  const metadata = [`path ${base64(new TextEncoder().encode(path))}`];
  if (digest !== null) metadata.push(`sha256 ${base64(new TextEncoder().encode(hex(digest)))}`);
  const token = newToken();
  const made = await persist(() => send(place, { method: "POST", headers: {
    ...TUS, "Upload-Length": String(size), "Upload-Metadata": metadata.join(","), "Idempotency-Key": token } }), link);
  await made.json(); // a body that is not read counts as a broken request
  return new URL(made.headers.get("Location"), location.origin).pathname;
}

async function offsetOf(target) {
  const answer = await send(target, { method: "HEAD", headers: TUS });
  return Number(answer.headers.get("Upload-Offset"));
}

async function patch(target, offset, piece, signal) {
  const digest = await sha256(piece);
  const checksum = digest === null ? {} : { "Upload-Checksum": `sha256 ${base64(digest)}` };
  const answer = await send(target, { method: "PATCH", body: piece, signal, headers: {
    ...TUS, "Upload-Offset": String(offset), "Content-Type": "application/offset+octet-stream", ...checksum } });
  return Number(answer.headers.get("Upload-Offset"));
}

/** Do something until the server can be reached. */
async function persist(action, link) {
  for (let wait = 1; ; wait = Math.min(2 * wait, LONGEST_WAIT_S)) {
    try {
      const done = await action();
      link.lost(false);
      return done;
    } catch (error) {
      if (!(error instanceof Refusal) || ![0, 429, 503].includes(error.status)) throw error;
      link.lost(true);
    }
    await pause(wait, link.signal);
  }
}

function pause(seconds, signal) {
  return new Promise((resolve, reject) => {
    const stop = () => { clearTimeout(timer); reject(new Stopped()); };
    const timer = setTimeout(() => { signal.removeEventListener("abort", stop); resolve(); }, seconds * 1000);
    if (signal.aborted) stop();
    signal.addEventListener("abort", stop, { once: true });
  });
}

/** Return a digest; null where the browser has none, which is so on pages without TLS from another machine. */
async function sha256(data) {
  return crypto.subtle === undefined ? null : new Uint8Array(await crypto.subtle.digest("SHA-256", data));
}

function hex(digest) {
  return Array.from(digest, (byte) => byte.toString(16).padStart(2, "0")).join("");
}

function base64(data) {
  return btoa(Array.from(data, (byte) => String.fromCharCode(byte)).join(""));
}
