/** Deletion that can be undone for some seconds, because it is only done after them. */

import { attempt, remove } from "../api.js";
import { byId, element } from "../element.js";

const GRACE_S = 8;
let pending = false; // one at a time: what is undone is what is shown

/**
 * Delete something in some seconds, unless the person undoes it or leaves the page.
 * @param {string} path Of what is deleted. @param {string} name Of it. @param {string} then Page that is shown afterwards.
 */
export function removeLater(path, name, then) {
  if (pending) return;
  pending = true;
  let left = GRACE_S;
  const words = element("span", {});
  const present = () => { words.textContent = `${name} is deleted in ${left} s.`; };
  const undo = element("button", { type: "button", onclick: () => {
    clearInterval(timer);
    line.remove();
    pending = false;
  } }, "Undo");
  const line = element("p", { class: "notice" }, words, undo);
  const timer = setInterval(() => {
    left -= 1;
    present();
    if (!line.isConnected) byId("message").append(line); // another message has taken its place
    if (left > 0) return;
    clearInterval(timer);
    undo.disabled = true;
    attempt(async () => {
      await remove(path);
      location.assign(then);
    }).finally(() => {
      line.remove();
      pending = false;
    });
  }, 1000);
  addEventListener("pagehide", () => clearInterval(timer), { once: true });
  present();
  byId("message").replaceChildren(line);
  undo.focus();
}
