/** What a page shows where the thing that its address names does not exist. */

import { byId, element, icon } from "./element.js";

/** Put a sentence and ways on in place of the content of the page. */
export function showFaultPage(sentence) {
  document.title = "Not found · Relit";
  byId("main").replaceChildren(element("div", { class: "fault-page", role: "alert" }, icon("warning"), element("h1", {}, "This is not here"),
    element("p", {}, `${sentence.charAt(0).toUpperCase()}${sentence.slice(1)}.`), element("p", { class: "help" }, "It may have been deleted, or belong to another project: a key sees its own project alone."),
    element("p", { class: "actions" }, element("a", { class: "button", href: "/" }, icon("home"), "All captures"),
      element("button", { type: "button", class: "quiet", onclick: () => location.reload() }, icon("again"), "Try again"))));
}
