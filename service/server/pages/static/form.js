/** Forms of jobs: what was entered, as JSON of the API, as a command of relit and as a request of curl. */

import { attempt, hasKey, listing, Refusal, submitJob } from "./api.js";
import { element } from "./element.js";
import { once } from "./once.js";

/**
 * Make the forms of a page work.
 * @param {ParentNode} root Where they are.
 * @param {string} subject Identifier of the capture or job that they begin with.
 */
export function enableForms(root, subject) {
  for (const form of root.querySelectorAll("form[data-kind]")) {
    const details = form.closest("details");
    enter(form, subject);
    if (details.open) attempt(() => fillLists(form));
    else details.addEventListener("toggle", () => attempt(() => fillLists(form)), { once: true });
    form.addEventListener("input", () => present(form));
    form.addEventListener("submit", (event) => {
      event.preventDefault();
      attempt(() => once(form, () => submit(form)));
    });
    for (const chooser of form.querySelectorAll("input[data-fills]")) chooser.addEventListener("change", () => attempt(() => fillFrom(form, chooser)));
    for (const button of form.querySelectorAll("button.copy")) {
      button.addEventListener("click", () => attempt(() => copy(form, button)));
    }
  }
}

/** Return the text of the command that does the same as a job request. */
export function commandOf(kind, options) {
  const parts = ["relit", "submit", kind];
  if (location.port !== "8470" || !["localhost", "127.0.0.1"].includes(location.hostname)) parts.push("--server", location.origin);
  parts.splice(3, 0, ...options.filter(({ isArgument }) => isArgument).map(({ value }) => quoted(value)));
  for (const { flag, value, isArgument } of options) {
    if (isArgument) continue;
    if (value === true) parts.push(flag);
    else parts.push(flag, quoted(value));
  }
  return parts.join(" ");
}

/** Return the text of the curl command that sends a job request. */
export function curlOf(request) {
  const key = hasKey() ? ` -H "Authorization: Bearer $RELIT_KEY"` : "";
  return `curl -sS ${location.origin}/v1/jobs${key} -H 'Content-Type: application/json' -d ${quoted(JSON.stringify(request))}`;
}

/** Enter what the page is about, before anything is listed: a person may submit at once, and what is chosen while lists come stays. */
function enter(form, subject) {
  for (const control of form.querySelectorAll(".field[data-argument] :is(select, textarea)[data-lists]")) {
    if (subject !== "" && control.localName === "select") control.append(element("option", { value: subject }, subject));
    control.value ||= subject;
  }
  present(form);
}

async function fillLists(form) {
  for (const select of form.querySelectorAll("select[data-lists]")) await fill(select);
}

/** Add what can be chosen, by its name and identifier; what the page is about is there already, and gets its name. */
function put(select, value, name) {
  const words = `${name} · ${value}`;
  const before = [...select.options].find((option) => option.value === value);
  if (before === undefined) select.append(element("option", { value }, words));
  else before.textContent = words;
}

async function fill(select) {
  const kind = select.dataset.lists;
  if (kind === "job") {
    for await (const job of listing("/v1/jobs?state=succeeded", "jobs")) {
      if (["solve", "pipeline", "depth", "join", "register"].includes(job.request.kind)) {
        put(select, job.id, job.request.name || job.request.kind);
      }
    }
    return;
  }
  for await (const item of listing(`/v1/${kind}s`, "items")) {
    if (item.state === "ready") put(select, item.id, item.name);
  }
}

async function submit(form) {
  const fault = form.querySelector(".fault");
  fault.hidden = true;
  try {
    const { request } = entered(form);
    const job = await submitJob(request);
    location.assign(`/jobs/${job.id}`);
  } catch (error) {
    if (!(error instanceof Refusal)) throw error;
    fault.textContent = error.message;
    fault.hidden = false;
    fault.scrollIntoView({ block: "nearest" });
  }
}

function present(form) {
  let command;
  let curl;
  try {
    const { request, options } = entered(form);
    command = commandOf(form.dataset.kind, options);
    curl = curlOf(request);
  } catch (error) {
    if (!(error instanceof Refusal)) throw error;
    command = curl = error.message;
  }
  form.querySelector("[data-shows=command]").textContent = command;
  form.querySelector("[data-shows=curl]").textContent = curl;
}

/** Put the content of a chosen file into the text of its field. */
async function fillFrom(form, chooser) {
  const [file] = chooser.files;
  if (file === undefined) return;
  chooser.closest(".field").querySelector("textarea").value = await file.text();
  chooser.value = "";
  present(form);
}

async function copy(form, button) {
  await navigator.clipboard.writeText(form.querySelector(`[data-shows=${button.dataset.copies}]`).textContent);
  button.textContent = "Copied";
}

/** Return the request of a form, and its options as a command has them. What has its default is left out. */
export function entered(form) {
  const request = { kind: form.dataset.kind };
  const options = [];
  for (const field of form.querySelectorAll(".field")) {
    const value = valueOf(field);
    if (value === undefined) continue;
    for (const path of field.dataset.paths.split(" ")) place(request, path.split("."), value);
    const isArgument = field.hasAttribute("data-argument");
    for (const each of field.dataset.type === "strings" ? value : [Array.isArray(value) ? value.join(",") : value]) {
      const flag = each === false ? field.dataset.off : field.dataset.flag;
      const typed = field.dataset.type === "json" ? `${field.dataset.name}.json` : typeof each === "boolean" ? true : String(each);
      options.push({ flag, value: typed, isArgument });
    }
  }
  return { request, options };
}

function valueOf(field) {
  const control = field.querySelector("input:not([type=file]), select, textarea");
  const label = field.querySelector("label").textContent;
  if (field.dataset.type === "boolean") {
    return control.checked === (field.dataset.default === "true") ? undefined : control.checked;
  }
  const text = control.value.trim();
  if (control.required && text === "") throw new Refusal(422, `${label}: choose one`);
  if (text === "" || text === field.dataset.default) return undefined;
  switch (field.dataset.type) {
    case "integer":
    case "number":
      return number(label, text, control, field.dataset.type === "integer");
    case "strings":
      return text.split("\n").map((line) => line.trim()).filter((line) => line !== "");
    case "integers":
    case "numbers":
      return parts(text).map((part) => number(label, part, control, field.dataset.type === "integers"));
    case "words":
      return parts(text);
    case "json":
      try {
        return JSON.parse(text);
      } catch (error) {
        throw new Refusal(422, `${label}: is no JSON: ${error.message}`);
      }
    default:
      return text;
  }
}

/** Return what stands between the commas of a text. */
function parts(text) {
  return text.split(",").map((part) => part.trim());
}

function number(label, text, control, whole) {
  const value = Number(text);
  const { low = "", high = "" } = control.dataset;
  if (!Number.isFinite(value) || (whole && !Number.isInteger(value))) {
    throw new Refusal(422, `${label}: is ${text}: give a ${whole ? "whole " : ""}number`);
  }
  if ((low !== "" && value < Number(low)) || (high !== "" && value > Number(high))) {
    throw new Refusal(422, `${label}: is ${text}: give ${low === "" ? "at most" : high === "" ? "at least" : `${low} to`} ${high || low}`);
  }
  return value;
}

function place(target, path, value) {
  for (const name of path.slice(0, -1)) target = target[name] ??= {};
  target[path.at(-1)] = value;
}

function quoted(text) {
  return /^[\w@%+=:,./-]+$/.test(text) ? text : `'${String(text).replaceAll("'", "'\\''")}'`;
}
