/** The page of one capture: its facts, its frames on the dome, and the forms of the jobs that begin with it. */

import { attempt, listing, load, read, remove } from "./api.js";
import { byId, element, factText, show, words } from "./element.js";
import { mountDome } from "./dome.js";
import { watch } from "./events.js";
import { enableForms } from "./form.js";
import { JobsTable } from "./jobs_table.js";
import { chosenStep } from "./time_steps.js";
import { openView } from "./view_jobs.js";

const identifier = byId("main").dataset.identifier;
const table = new JobsTable(byId("jobs"), (job) => job.request.capture === identifier || job.request.intake === identifier);

async function open() {
  let capture = await read(`/v1/captures/${identifier}`);
  present(capture);
  while (capture.state === "checking") {
    await new Promise((resolve) => { setTimeout(resolve, 500); });
    capture = await read(`/v1/captures/${identifier}`);
    present(capture);
  }
  if (capture.state !== "ready") return;
  show(byId("work"), true);
  enableForms(byId("work"), identifier);
  if ((capture.facts?.frames ?? 0) > 0) await load(look);
}

function present(capture) {
  document.title = `${capture.name} · Relit`;
  byId("name").textContent = capture.name;
  byId("state").textContent = capture.problem ?? (capture.state === "receiving" ? "Not all files are here yet: drop its folder on the page of captures to continue." : capture.state);
  byId("state").classList.toggle("fault", capture.problem !== null);
  const facts = Object.entries({ identifier: capture.id, ...(capture.registered ? { place: "a folder of the server" } : {}), ...capture.facts });
  byId("facts").replaceChildren(...facts.flatMap(([name, value]) => [element("dt", {}, words(name)), element("dd", {}, factText(name, value))]));
}

async function look() {
  const step = await chosenStep(identifier);
  const { files } = await openView(identifier, null, step);
  const view = await files.json("view.json");
  show(byId("relight"), view.relight !== null && step === null);
  byId("findings").replaceChildren(...view.findings.map((finding) => element("li", {}, finding)));
  if (view.frames.length === 0) return;
  show(byId("lights"), true);
  const atlas = await createImageBitmap(new Blob([await files.bytes("thumbnails.jpg")], { type: "image/jpeg" }));
  const figures = view.frames.map((frame, index) => figure(frame, index, atlas));
  byId("frames").replaceChildren(...figures);
  let mark = () => {};
  const choose = (index) => {
    figures.forEach((each, at) => each.classList.toggle("chosen", at === index));
    figures[index].scrollIntoView({ block: "nearest", inline: "nearest" });
    mark(index);
  };
  if (view.frames.some((frame) => frame.direction !== null)) mark = mountDome(byId("dome"), view.frames, choose);
}

function figure(frame, index, atlas) {
  const [x, y, width, height] = frame.thumbnail ?? [0, 0, 96, 96];
  const canvas = element("canvas", { width, height, role: "img", "aria-label": `Frame ${index + 1}: ${frame.image}` });
  if (frame.thumbnail !== null) canvas.getContext("2d").drawImage(atlas, x, y, width, height, 0, 0, width, height);
  const clipped = frame.saturated === null ? "cannot be read" : frame.saturated > 0.0005 ? `${(100 * frame.saturated).toFixed(1)} % clipped` : null;
  return element("figure", { class: frame.suspect === null ? "" : "suspect" }, canvas,
    element("figcaption", {}, frame.image, element("small", {}, [frame.label, clipped, frame.suspect].filter(Boolean).join(" · "))));
}

byId("delete").addEventListener("click", () => attempt(async () => {
  if (!confirm("Delete this capture from the service? A registered folder stays where it lies.")) return;
  await remove(`/v1/captures/${identifier}`);
  location.assign("/captures");
}));
await load(open);
await load(async () => { for await (const job of listing("/v1/jobs?limit=500", "jobs")) table.put(job); });
await attempt(() => watch("/v1/events", { job: (job) => table.put(job), gone: ({ id }) => table.drop(id) }));
