/** Where folders and files are dropped or chosen, uploaded, looked at and imported. */

import { attempt, post, Refusal } from "../api.js";
import { bytes, byId, element, rate } from "../element.js";
import { chosenFolder, droppedFiles, isCapture, isEnvironment } from "./local_files.js";
import { proposalOf } from "./proposal.js";
import { settled, Stopped, upload } from "./upload.js";

let changed = () => {};

/**
 * Take what is dropped on the elements of drop.html.
 * @param {function(string): Promise<void>} onchange Is told "captures" or "environments" when one of them has changed.
 */
export function mountDropZone(onchange) {
  changed = onchange;
  const drop = byId("drop");
  for (const kind of ["dragover", "drop"]) addEventListener(kind, (event) => event.preventDefault()); // else the browser opens a file that misses it
  drop.addEventListener("dragover", (event) => { event.preventDefault(); drop.classList.add("over"); });
  drop.addEventListener("dragleave", () => drop.classList.remove("over"));
  drop.addEventListener("drop", (event) => {
    event.preventDefault();
    drop.classList.remove("over");
    attempt(async () => Promise.all((await droppedFiles(event.dataTransfer)).map(take)));
  });
  byId("folder").addEventListener("change", (event) => {
    const found = chosenFolder(event.target.files);
    event.target.value = "";
    attempt(() => take(found));
  });
  byId("file").addEventListener("change", (event) => {
    const [file] = event.target.files;
    event.target.value = "";
    if (file !== undefined) attempt(() => take({ name: file.name, files: [{ path: file.name, file }] }));
  });
}

/** Ask how the files of a capture are imported that were looked at. */
export function askHowToImport(item) {
  const status = element("span", { role: "status" });
  const line = element("li", {}, element("strong", {}, item.name), " ", status);
  byId("uploads").append(line);
  line.scrollIntoView({ block: "nearest" });
  return attempt(() => end("captures", { ...item, state: "receiving" }, line, status, { signal: new AbortController().signal, lost: () => {} }));
}

async function begin(what, name, files, then = "validate") {
  const stop = new AbortController();
  const status = element("span", { role: "status" }, "beginning");
  const bar = element("progress", { "aria-label": `Upload of ${name}` });
  const button = element("button", { type: "button", class: "quiet", onclick: () => stop.abort() }, "Stop");
  const line = element("li", {}, element("strong", {}, name), " ", bar, " ", button, " ", status); // a text that grows moves no button
  byId("uploads").append(line);
  const leaving = (event) => event.preventDefault();
  addEventListener("beforeunload", leaving);
  let told = "";
  let over = false; // requests under way when an upload is stopped may fail afterwards
  const link = { signal: stop.signal, lost: (isLost) => {
    if (over) return;
    status.textContent = isLost ? "The server cannot be reached. The upload waits, and goes on by itself." : told;
  } };
  let begun;
  try {
    const found = await upload(what, name, files, (sent, total, doing) => {
      begun ??= { sent, at: performance.now() }; // what the server has already is no rate
      bar.max = Math.max(total, 1);
      bar.value = sent;
      told = doing === "checking" ? (then === "guess" ? "complete, being looked at" : "complete, being checked") :
        `${bytes(sent)} of ${bytes(total)}${rate(sent - begun.sent, total - begun.sent, (performance.now() - begun.at) / 1000)}`;
      status.textContent = told;
    }, link, then);
    await end(what, found, line, status, link);
    bar.remove(); // not before the question stands there: a line without either is over, and goes when the panel is closed
  } catch (error) {
    if (!(error instanceof Refusal || error instanceof Stopped || error.name === "AbortError")) throw error;
    over = true;
    bar.remove();
    status.className = "fault";
    status.textContent = error instanceof Refusal ? error.message : "Stopped. Drop the same folder again to continue: what the server has is not sent again.";
  } finally {
    removeEventListener("beforeunload", leaving);
    button.remove();
    await attempt(() => changed(what));
  }
}

/** Show how an upload ended: ready, refused, or with the question what the files are. */
async function end(what, found, line, status, link) {
  status.className = found.state === "refused" ? "fault" : "";
  status.textContent = found.problem ?? (found.state === "ready" ? "ready" : "");
  if (what !== "captures") return;
  if (found.state !== "receiving") {
    status.append(" ", element("a", { href: `/captures/${found.id}` }, "Look at it"));
    if (found.state === "ready") status.append(" · ", element("a", { href: `/object/${found.id}` }, "Open the object"));
    return;
  }
  line.append(await proposalOf(found, async (importing) => {
    status.textContent = "being imported";
    const imported = await settled(importing, "captures", link);
    if (imported.state === "ready" && [...byId("uploads").children].every((each) => each === line || !isUnderWay(each))) location.assign(`/object/${imported.id}`);
    else if (imported.state === "ready") await end(what, imported, line, status, link);
    else status.textContent = "";
    await changed(what);
    return imported;
  }));
}

/** Return whether what a line is about is still sent, looked at or asked about. */
export function isUnderWay(line) {
  return line.querySelector("progress, .proposal") !== null;
}

async function take(found) {
  const single = found.files.length === 1 && !found.files[0].path.includes("/") ? found.files[0] : null;
  if (single !== null && isEnvironment(found.name)) return begin("environments", found.name.replace(/\.\w+$/, ""), [single]);
  if (isCapture(found)) return begin("captures", found.name, found.files);
  try {
    const local = new Map(found.files.map(({ path, file }) => [path, file]));
    const { captures } = await post("/v1/needed-files",
      { files: found.files.map(({ path, file }) => ({ path, length: file.size })) });
    leftOut(found, captures.flatMap(({ files }) => files));
    return Promise.all(captures.map(({ folder, files }) => begin("captures", folder === "" ? found.name : `${found.name}/${folder}`,
      files.map(({ path, name }) => ({ path: name, file: local.get(path) })), "guess")));
  } catch (error) {
    if (!(error instanceof Refusal)) throw error;
    byId("uploads").append(element("li", { class: "fault" }, `${found.name}: ${error.message}`));
    return undefined;
  }
}

/** Say what of a folder is not sent. */
function leftOut({ name, files }, needed) {
  const left = files.filter(({ path }) => !needed.some((each) => each.path === path));
  if (left.length === 0) return;
  const size = left.reduce((sum, { file }) => sum + file.size, 0);
  byId("uploads").append(element("li", { class: "left-out" }, `${name}: ${left.length} ${left.length === 1 ? "file" : "files"} of ${bytes(size)} ` +
    `that no import needs ${left.length === 1 ? "stays" : "stay"} on this machine`));
}
