/** The page of one capture: its facts, its frames on the dome, and the forms of the jobs that begin with it. */

import { attempt, listing, load } from "../api.js";
import { byId, element, factRows, show } from "../element.js";
import { watch } from "../events.js";
import { enableForms } from "../form.js";
import { JobsTable } from "../jobs_table.js";
import { hasUnknownLights, heldBy, litFacts, offerSteps, setPrimary } from "../object/next_steps.js";
import { mountPhotographs } from "../object/photographs.js";
import { removeLater } from "../object/removal.js";
import { proposalOf } from "../upload/proposal.js";
import { calibrationList } from "./calibrations.js";
import { offerPreview } from "./preview.js";
import { chosenStep } from "../time_steps.js";
import { settled } from "../upload/upload.js";
import { ViewFile } from "../view/view_file.js";
import { checked, openView } from "../view_jobs.js";

const identifier = byId("main").dataset.identifier;
const table = new JobsTable(byId("jobs"), (job) => job.request.capture === identifier || job.request.intake === identifier);

async function open() {
  const capture = await checked(identifier, present);
  present(capture);
  if (capture.state === "receiving" && capture.facts?.proposal !== undefined) await ask(capture);
  if (capture.state !== "ready") return;
  offer(capture.facts ?? {});
  enableForms(byId("work"), identifier);
  if ((capture.facts?.frames ?? 0) > 0) await load(() => look(capture.facts));
}

/** Ask how files are imported that were looked at. */
async function ask(capture) {
  const link = { signal: new AbortController().signal, lost: () => {} };
  byId("state").after(await proposalOf(capture, async (importing) => {
    const imported = await settled(importing, "captures", link);
    if (imported.state === "ready") location.reload();
    return imported;
  }));
}

function present(capture) {
  document.title = `${capture.name} · Relit`;
  byId("name").textContent = capture.name;
  const missing = capture.facts?.proposal === undefined ? "Not all files are here yet: drop its folder on the page of captures to continue." : "Its files are here: say how they are imported.";
  byId("state").textContent = capture.problem ?? (capture.state === "receiving" ? missing : capture.state);
  byId("state").classList.toggle("fault", capture.problem !== null);
  byId("facts").replaceChildren(...factRows({ identifier: capture.id, ...(capture.registered ? { place: "a folder of the server" } : {}), ...capture.facts }));
}

/** Show what can be done with a capture that holds this: what it is made for as buttons, the same with options, and the rest behind More. */
function offer(facts) {
  const holds = heldBy(facts);
  const first = offerSteps(byId("next"), facts, identifier, [], toObject);
  setPrimary(byId("next"));
  for (const box of byId("more").querySelectorAll(".job-form")) {
    if (holds.length > 0 && !box.dataset.begins.split(" ").some((each) => holds.includes(each))) box.remove();
    else if (first.includes(box.querySelector("form").dataset.kind)) byId("first").append(box);
  }
  for (const group of byId("more").querySelectorAll("[data-group]")) show(group, group.querySelector(".job-form") !== null);
  if (hasUnknownLights(facts)) {
    for (const choice of byId("work").querySelectorAll("[data-kind=solve] [data-name=lights] select, [data-kind=pipeline] [data-name=lights] select")) choice.value = "unknown";
  }
  offerPreview(byId("preview"), byId("previewed"), identifier, facts, first[0]);
  const list = calibrationList(facts, byId("more"));
  if (list !== null) byId("calibrations").append(list);
  show(byId("calibrations"), list !== null);
  show(byId("work"), true);
}

async function fillTable() {
  for await (const job of listing("/v1/jobs?limit=500", "jobs")) table.put(job);
}

/** Go where a job that was begun is followed, and what it makes is shown. */
function toObject() {
  location.assign(`/object/${identifier}`);
}

async function look(facts) {
  const step = await chosenStep(facts);
  const { files } = await openView(identifier, null, step, byId("preparing"));
  const view = await ViewFile.open(files);
  if (heldBy(facts).length === 0) offerSteps(byId("next"), litFacts(facts, view), identifier, [], toObject);
  show(byId("relight"), view.info.relight !== null && step === null);
  setPrimary(byId("next"));
  byId("findings").replaceChildren(...view.info.findings.map((finding) => element("li", {}, finding)));
  if (view.info.frames.length === 0) return;
  show(byId("lights"), true);
  await mountPhotographs(byId("frames"), byId("dome"), view);
}

byId("delete").addEventListener("click", () => removeLater(`/v1/captures/${identifier}`, byId("name").textContent, "/captures"));
await load(() => Promise.all([open(), fillTable()]));
await attempt(() => watch("/v1/events", { job: (job) => table.put(job), gone: ({ id }) => table.drop(id) }));
