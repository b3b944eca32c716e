/** The page of captures and environments: lists them, and uploads new ones. */

import { attempt, listing, load, Refusal } from "./api.js";
import { bytes, byId, element, time } from "./element.js";
import { chosenFolder, droppedFiles, faultOfCapture, isEnvironment } from "./local_files.js";
import { Stopped, upload } from "./upload.js";

async function list(what) {
  const body = byId(what).tBodies[0];
  const rows = [];
  for await (const item of listing(`/v1/${what}`, "items")) {
    const name = what === "captures" ? element("a", { href: `/captures/${item.id}` }, item.name) : item.name;
    rows.push(element("tr", {}, element("td", {}, name, " ", element("small", {}, item.id)),
      element("td", {}, element("span", { class: `state ${item.state}` }, item.state)),
      element("td", {}, item.problem ?? content(item.facts)), element("td", {}, time(item.created_at))));
  }
  body.replaceChildren(...(rows.length > 0 ? rows : [element("tr", {}, element("td", { colspan: 4 }, `There are no ${what} yet.`))]));
}

function content(facts) {
  if (facts === null) return "";
  const parts = [];
  if (facts.frames !== undefined) parts.push(`${facts.frames} frames`);
  if (facts.resolution !== undefined) parts.push(facts.resolution.join(" × "));
  return parts.join(", ");
}

async function begin(what, name, files) {
  const stop = new AbortController();
  const status = element("span", {}, "beginning");
  const bar = element("progress", { "aria-label": `Upload of ${name}` });
  const button = element("button", { type: "button", class: "quiet", onclick: () => stop.abort() }, "Stop");
  const line = element("li", {}, element("strong", {}, name), " ", bar, " ", button, " ", status); // a text that grows moves no button
  byId("uploads").append(line);
  const leaving = (event) => event.preventDefault();
  addEventListener("beforeunload", leaving);
  try {
    const found = await upload(what, name, files, (sent, total, doing) => {
      bar.max = Math.max(total, 1);
      bar.value = sent;
      status.textContent = doing === "checking" ? "complete, being checked" : `${bytes(sent)} of ${bytes(total)}`;
    }, stop.signal);
    bar.remove();
    status.className = found.state === "refused" ? "fault" : "";
    status.textContent = found.state === "refused" ? found.problem : "ready";
    if (what === "captures") status.append(" ", element("a", { href: `/captures/${found.id}` }, "Look at it"));
  } catch (error) {
    if (!(error instanceof Refusal || error instanceof Stopped || error.name === "AbortError")) throw error;
    bar.remove();
    status.className = "fault";
    status.textContent = error instanceof Refusal ? error.message : "Stopped. Drop the same folder again to continue: what the server has is not sent again.";
  } finally {
    removeEventListener("beforeunload", leaving);
    button.remove();
    await attempt(() => list(what));
  }
}

function take(found) {
  const single = found.files.length === 1 && !found.files[0].path.includes("/") ? found.files[0] : null;
  if (single !== null && isEnvironment(found.name)) return begin("environments", found.name.replace(/\.\w+$/, ""), [single]);
  const fault = faultOfCapture(found);
  if (fault === null) return begin("captures", found.name, found.files);
  byId("uploads").append(element("li", { class: "fault" }, fault));
  return Promise.resolve();
}

const drop = byId("drop");
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
await load(() => Promise.all([list("captures"), list("environments")]));
