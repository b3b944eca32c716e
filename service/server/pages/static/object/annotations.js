/** Notes on an object: numbered marks over its picture, a list of them, and new ones by a click or a drag. The server keeps them as Web Annotations (W3C). */

import { attempt, post, read, remove } from "../api.js";
import { element, show } from "../element.js";
import { newest, once } from "../once.js";
import { mountNotes } from "../publish/overlay.js";

const DRAG_PX = 5; // a pointer that moves less marks a point
const CLOSE = 3; // zoom at which a note about a point is shown
const HELP = "Click a point of the object, or drag a region. Enter marks the middle of the picture, Escape ends.";

/** Return a note in pixels of the picture; `step` pixels of the capture are one of it. */
function noteOf({ id, body, target: { selector } }, step) {
  const box = selector.type === "PointSelector" ? [selector.x, selector.y, 0, 0] : selector.value.replace(/^.*[=:]/, "").split(",").map(Number);
  const [x, y, width, height] = box.map((value) => value / step);
  return { id, text: body.value, x, y, width, height };
}

/**
 * Show the notes of a capture, and take new ones.
 * @param {HTMLElement} parent Takes the list.
 * @param {string} capture Identifier.
 * @param {{notes: HTMLElement, onplace: function(function): void, pixelOf: function(number, number): number[], show: function(object): void,
 *     tools: HTMLElement, width: number, height: number, step: number}} picture As zoomed_picture.js gives it, with the pixels of the capture that each of its pixels is.
 */
export async function mountAnnotations(parent, capture, picture) {
  const path = `/v1/captures/${capture}/annotations`;
  const words = element("textarea", { rows: 2, maxlength: 2000, required: true, "aria-label": "Text of the note" });
  const form = element("form", { class: "note-form", hidden: true }, words, element("p", { class: "actions" }, element("button", { type: "submit" }, "Keep the note"),
    element("button", { type: "button", class: "quiet", onclick: () => end() }, "Cancel")));
  const list = element("section", { "aria-label": "Notes", class: "notes-list", hidden: true }, element("h2", {}, "Notes"), element("ol"));
  const add = element("button", { type: "button", class: "quiet", "aria-pressed": "false", onclick: () => (marking.hidden ? begin() : end()) }, "Add a note");
  const marking = element("div", { class: "marking", tabindex: 0, role: "button", "aria-label": HELP, title: HELP, hidden: true });
  const area = element("div", { class: "area", hidden: true });
  marking.append(area);
  const asked = newest();
  let place = null; // of the note that is written
  picture.tools.append(add);
  picture.notes.after(marking);
  picture.tools.after(form);
  parent.append(list);

  function begin() {
    add.setAttribute("aria-pressed", "true");
    show(marking, true);
    marking.focus();
  }

  function end() {
    add.setAttribute("aria-pressed", "false");
    for (const each of [marking, form, area]) show(each, false);
    words.value = "";
  }

  /** Ask for the text of a note about what lies between two points of the screen. */
  function ask([left, top], [right, bottom]) {
    const corners = [picture.pixelOf(Math.min(left, right), Math.min(top, bottom)), picture.pixelOf(Math.max(left, right), Math.max(top, bottom))];
    const [[x, y], [x1, y1]] = corners.map(([u, v]) => [Math.min(Math.max(u, 0), picture.width), Math.min(Math.max(v, 0), picture.height)]
      .map((value) => Math.floor(1000 * picture.step * value) / 1000));
    place = Math.hypot(right - left, bottom - top) < DRAG_PX ? { type: "PointSelector", x, y }
      : { type: "FragmentSelector", value: `xywh=${[x, y, x1 - x, y1 - y].map((value) => +value.toFixed(3)).join(",")}` };
    show(form, true);
    words.focus();
  }

  let from = null;
  const at = (event) => [event.clientX, event.clientY];
  marking.addEventListener("pointerdown", (event) => {
    from = at(event);
    marking.setPointerCapture(event.pointerId);
  });
  marking.addEventListener("pointermove", (event) => {
    if (from === null) return;
    const box = marking.getBoundingClientRect();
    const [x, y] = at(event);
    show(area, true);
    Object.assign(area.style, { left: `${Math.min(x, from[0]) - box.left}px`, top: `${Math.min(y, from[1]) - box.top}px`, width: `${Math.abs(x - from[0])}px`, height: `${Math.abs(y - from[1])}px` });
  });
  marking.addEventListener("pointerup", (event) => {
    if (from !== null) ask(from, at(event));
    from = null;
  });
  marking.addEventListener("keydown", (event) => {
    if (event.key === "Escape") end();
    if (event.key !== "Enter") return;
    event.preventDefault();
    const { left, top, width, height } = marking.getBoundingClientRect();
    const middle = [left + width / 2, top + height / 2];
    ask(middle, middle);
  });
  form.addEventListener("submit", (event) => {
    event.preventDefault();
    attempt(() => once(form, async () => {
      await post(path, { body: { type: "TextualBody", value: words.value }, target: { selector: place } });
      end();
      await present();
    }));
  });

  async function present() {
    const isNewest = asked();
    const notes = (await read(path)).items.map((each) => noteOf(each, picture.step));
    if (!isNewest()) return;
    picture.notes.replaceChildren();
    list.querySelector("ol").replaceChildren();
    picture.onplace(mountNotes(picture.notes, list, notes, ({ x, y, width, height }) => picture.show({
      centre: [x + width / 2, y + height / 2], zoom: width > 0 ? Math.max(1, 0.5 * Math.min(picture.width / width, picture.height / height)) : CLOSE })));
    list.querySelectorAll("li").forEach((item, index) => item.append(" ", element("button", { type: "button", class: "bare", "aria-label": `Delete note ${index + 1}`,
      onclick: () => attempt(async () => { await remove(notes[index].id); await present(); }) }, "Delete")));
  }

  await present();
}
