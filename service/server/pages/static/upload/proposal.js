/** What the server takes files for that are no capture yet: a sentence, what is left to be chosen, and the import. */

import { post, Refusal, send } from "../api.js";
import { element, show } from "../element.js";
import { entered } from "../form.js";

const ASKED = ["color_space", "focal_px", "pixel_size_m"]; // what files seldom say, and results depend on

/**
 * Show a proposal, and import as it says when the person agrees.
 * @param {any} capture As the server has it, with the fact `proposal`.
 * @param {function(any): Promise<any>} done Is given the capture whose import has begun; returns it when the import has ended.
 * @returns {Promise<HTMLElement>} The sentence and the form. It stays where an import was refused, and goes where the capture is ready.
 */
export async function proposalOf(capture, done) {
  const { proposal } = capture.facts;
  const { labels, fault, form } = await formOf(proposal, capture.id);
  const shown = element("div", { class: "proposal" },
    element("p", {}, element("strong", {}, proposal.summary)),
    element("p", {}, proposal.sure ? "Sure" : "Not sure", `: ${proposal.because}.`),
    proposal.lights === "unknown" ? element("p", {}, "Lights unknown: they are taken for distant ones, and found from the photographs when these are solved.") : null,
    proposal.assumed.length === 0 ? null : element("p", {}, "Taken for granted: "),
    element("ul", {}, ...proposal.assumed.map((sentence) => element("li", {}, sentence.replace(/--[a-z-]+/g, (flag) => labels.get(flag) ?? flag)))), form);
  form.addEventListener("submit", async (event) => {
    event.preventDefault();
    const button = form.querySelector("button");
    button.disabled = true;
    show(fault, false);
    try {
      const { kind, ...options } = entered(form).request;
      const found = await done(await post(`/v1/captures/${capture.id}/import`, { layout: kind, file: proposal.file, options }));
      if (found.state === "ready") shown.remove();
      else throw new Refusal(422, found.problem);
    } catch (error) {
      if (!(error instanceof Refusal)) throw error;
      fault.textContent = error.message;
      show(fault, true);
    } finally {
      button.disabled = false;
    }
  });
  return shown;
}

async function formOf(proposal, id) {
  const page = new DOMParser().parseFromString(await (await send(`/import-form/${proposal.layout}`)).text(), "text/html");
  const fields = [...page.querySelectorAll(".field")];
  for (const field of fields) {
    for (const name of ["id", "for", "list", "aria-describedby"]) { // several captures may be asked about at once
      for (const each of field.querySelectorAll(`[${name}]`)) each.setAttribute(name, `${id}-${each.getAttribute(name)}`);
    }
    const control = field.querySelector("input, select, textarea");
    fill(control, proposal.options[field.dataset.paths]);
    control.required = proposal.missing.includes(field.dataset.paths);
  }
  const wanted = [...proposal.missing, ...ASKED];
  const first = fields.filter(({ dataset }) => wanted.includes(dataset.paths));
  first.sort((one, other) => wanted.indexOf(one.dataset.paths) - wanted.indexOf(other.dataset.paths));
  const rest = fields.filter((field) => !first.includes(field));
  const fault = element("p", { class: "fault", role: "alert", hidden: true });
  const form = element("form", { "data-kind": proposal.layout, novalidate: true }, ...first,
    rest.length === 0 ? null : element("details", {}, element("summary", {}, "More choices"), ...rest),
    element("p", { class: "actions" }, element("button", { type: "submit" }, "Import")), fault);
  const labels = new Map(fields.map((field) => [field.dataset.flag, `“${field.querySelector("label").textContent}”`]));
  return { labels, fault, form };
}

function fill(control, value) {
  if (value === undefined) return;
  if (control.type === "checkbox") control.checked = value;
  else control.value = value;
}
