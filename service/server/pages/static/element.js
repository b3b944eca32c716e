/** Elements of a page, and values as people read them. */

const ICONS = new URL("look/icons.svg", import.meta.url).pathname;

/**
 * Make an element.
 * @param {string} tag Name of the element.
 * @param {Object<string, any>} [attributes] Attributes; `on…` are listeners, `class` the classes; false and null leave one out.
 * @param {...(Node|string|null)} children Content.
 * @returns {HTMLElement}
 */
export function element(tag, attributes = {}, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (value === false || value === null || value === undefined) continue;
    if (name.startsWith("on")) made.addEventListener(name.slice(2), value);
    else made.setAttribute(name, value === true ? "" : String(value));
  }
  made.append(...children.filter((child) => child !== null && child !== undefined));
  return made;
}

/** Return the element with an identifier, which the template has. */
export function byId(id) {
  const found = document.getElementById(id);
  if (found === null) throw new Error(`the page has no #${id}`);
  return found;
}

/** Let an element have these children; those that it has already stay where they are, and with them the focus and a click that has begun. */
export function setChildren(parent, children) {
  const wanted = new Set(children);
  for (const child of [...parent.childNodes]) if (!wanted.has(child)) child.remove();
  children.forEach((child, at) => { if (parent.childNodes[at] !== child) parent.insertBefore(child, parent.childNodes[at] ?? null); });
}

/** Show or hide an element. */
export function show(target, visible) {
  target.hidden = !visible;
}

/** Return what shows the number of a slider: it follows the hand, and the event `set` where the page has moved the slider. */
export function numberOf(slider) {
  const number = element("output", { class: "number" });
  const digits = (slider.step.split(".")[1] ?? "").length;
  const present = () => { number.textContent = Number(slider.value).toFixed(digits).replace("-", "−"); };
  for (const name of ["input", "set"]) slider.addEventListener(name, present);
  present();
  return number;
}

/** Return a number of bytes as a person reads it. */
export function bytes(count) {
  const units = ["bytes", "kB", "MB", "GB", "TB"];
  let at = 0;
  while (count >= 1000 && at < units.length - 1) {
    count /= 1000;
    at += 1;
  }
  return `${at === 0 ? count : count.toFixed(count < 10 ? 1 : 0)} ${units[at]}`;
}

/** Return how fast bytes are sent, and how long the rest takes, as a person reads it; empty where nothing can be said yet. */
export function rate(sent, total, seconds) {
  if (seconds < 1 || sent === 0) return "";
  return `, ${bytes(sent / seconds)}/s, ${duration((total - sent) * seconds / sent)} left`;
}

/** Return a duration as a person reads it. */
export function duration(seconds) {
  if (seconds < 60) return `${seconds.toFixed(seconds < 10 ? 1 : 0)} s`;
  const minutes = Math.round(seconds / 60);
  return minutes < 60 ? `${minutes} min` : `${Math.floor(minutes / 60)} h ${minutes % 60} min`;
}

/** Return a time element of an ISO time. */
export function time(iso) {
  const when = new Date(iso);
  return element("time", { datetime: iso, title: when.toString() }, when.toLocaleString([], { dateStyle: "medium", timeStyle: "short" }));
}

/** Return the words of a name: `color_space` is `Colour space`. */
export function words(name) {
  const text = name.replace("color", "colour").replaceAll("_", " ");
  return text.charAt(0).toUpperCase() + text.slice(1);
}

/** Return what a kind of job is called, as its form is. */
export function kindTitle(kind) {
  return JSON.parse(document.body.dataset.titles)[kind] ?? words(kind);
}

/** Return the facts of a capture as rows of a list, without what its page says elsewhere. */
export function factRows({ captures, name, lit_by: litBy, calibrated, proposal, ...facts }) {
  const shown = captures > 1 ? { captures, ...facts } : facts;
  return Object.entries(shown).flatMap(([fact, value]) => [element("dt", {}, words(fact)), element("dd", {}, factText(fact, value))]);
}

/** Return a fact's value as text: lists with commas, several dimensions with ×. */
function factText(name, value) {
  if (Array.isArray(value)) return value.join(name === "resolution" ? " × " : ", ");
  if (value === null || value === undefined) return "–";
  return typeof value === "object" ? JSON.stringify(value) : String(value);
}

/** Return a drawing of icons.svg. */
export function icon(name) {
  const [drawing, use] = ["svg", "use"].map((tag) => document.createElementNS("http://www.w3.org/2000/svg", tag));
  drawing.setAttribute("class", "icon");
  drawing.setAttribute("aria-hidden", "true");
  use.setAttribute("href", `${ICONS}#${name}`);
  drawing.append(use);
  return drawing;
}

/** Tell the person something, below the page and to screen readers; `again` is done when the person asks to try again. */
export function tell(sentence, kind = "fault", again = null) {
  const line = element("p", { class: kind }, element("span", {}, sentence));
  const dismiss = element("button", { type: "button", class: "bare", "aria-label": "Dismiss", onclick: () => line.remove() }, icon("close"));
  const repeat = element("button", { type: "button", onclick: () => { line.remove(); again(); } }, icon("again"), "Try again");
  line.append(element("span", { class: "actions" }, again === null ? null : repeat, dismiss));
  byId("message").replaceChildren(line);
}
