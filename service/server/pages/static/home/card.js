/** The card of an item: its picture, and a few words. */

import { element, icon, show, time, words } from "../element.js";

/** Return the card of an item; its picture is put into `.shown` when it comes into sight. */
export function cardOf(item) {
  const name = item.href === null ? item.name : element("a", { href: item.href }, item.name || words(item.kind));
  const isFlat = item.kind === "environment";
  return element("li", { class: isFlat ? "card flat" : "card", "data-id": item.id },
    element("div", { class: "shown" }, icon(item.kind)),
    element("div", { class: "text" }, element("h3", {}, name),
      element("div", { class: "kind" }, element("span", {}, words(item.kind)), shortTime(item.created)),
      item.problem === null ? element("span", {}, item.size) : element("span", { class: "fault" }, item.problem),
      item.state === "ready" ? null : element("span", { class: `state ${item.state}` }, waitsForChoice(item) ? "waits for your choice" : item.state)));
}

/** Return whether files were looked at, and somebody has to say how they are imported. */
function waitsForChoice({ state, source }) {
  return state === "receiving" && source.facts?.proposal !== undefined;
}

/** Put a picture into a card, in place of the drawing of its kind. */
export function setPicture(card, canvas) {
  const place = card.querySelector(".shown");
  place.querySelector("canvas")?.remove();
  place.append(canvas);
  show(place.querySelector(".icon"), false);
}

function shortTime(iso) {
  const made = time(iso);
  const today = new Date().toDateString() === new Date(iso).toDateString();
  made.textContent = new Date(iso).toLocaleString([], today ? { timeStyle: "short" } : { dateStyle: "medium" });
  return made;
}
