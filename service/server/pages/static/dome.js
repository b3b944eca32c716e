/** Lights as a diagram seen from the camera: those of a capture, and the lamps of a rig. */

import { element } from "./element.js";

const SVG = "http://www.w3.org/2000/svg";

/** Return where a direction lies in the diagram: the view axis in the middle, 90° from it at the radius 1, 180° at 2. */
export function placeOf([x, y, z]) {
  const angle = Math.acos(Math.max(-1, Math.min(1, z))) / (Math.PI / 2);
  const across = Math.hypot(x, y) || 1;
  return [angle * x / across, -angle * y / across];
}

/**
 * Show the lights of a view.
 * @param {HTMLElement} parent Takes the diagram.
 * @param {any[]} frames Of view.json.
 * @param {function(number): void} choose Called with the index of a frame that was chosen.
 * @returns {function(number): void} Marks a frame as chosen.
 */
export function mountDome(parent, frames, choose) {
  const lights = frames.map((frame, index) => ({ frame, index })).filter(({ frame }) => frame.direction !== null);
  const reach = Math.max(1, ...lights.map(({ frame }) => Math.hypot(...placeOf(frame.direction))));
  const size = 2 * reach + 0.3;
  const svg = shape("svg", { viewBox: `${-size / 2} ${-size / 2} ${size} ${size}`, role: "group", "aria-label": "Lights, seen from the camera" });
  for (const degrees of [30, 60, 90]) {
    svg.append(shape("circle", { r: degrees / 90, class: "ring" }), label(degrees));
  }
  const dots = new Map();
  for (const { frame, index } of lights) {
    const [x, y] = placeOf(frame.direction);
    const dot = shape("circle", { cx: x, cy: y, r: 0.04, class: frame.suspect === null ? "light" : "light suspect", tabindex: 0, role: "button",
      "aria-label": `${frame.image}${frame.suspect === null ? "" : `, suspect: ${frame.suspect}`}` });
    dot.addEventListener("click", () => choose(index));
    dot.addEventListener("keydown", (event) => {
      if (event.key !== "Enter" && event.key !== " ") return;
      event.preventDefault();
      choose(index);
    });
    dots.set(index, dot);
    svg.append(dot);
  }
  parent.replaceChildren(svg, element("p", { class: "help" }, "Circles: 30°, 60° and 90° from the view axis. Suspect lights are red."));
  return (chosen) => {
    for (const [index, dot] of dots) dot.classList.toggle("chosen", index === chosen);
  };
}

/**
 * Show the lamps of a rig.
 * @param {HTMLElement} parent Takes the diagram.
 * @param {{name: string, direction: number[]}[]} lamps With the direction to each.
 * @param {(function(number): void) | null} choose Called with the index of a lamp that was clicked.
 * @returns {function({colours: number[][], levels: number[][], words?: string[]}): void} Colours the lamps by linear red, green and blue, 0 to 1; the levels of
 *   the primaries of each lamp, 0 to 1, are said of it, or words.
 */
export function mountLamps(parent, lamps, choose = null) {
  const places = lamps.map((lamp) => placeOf(lamp.direction));
  const size = 2 * Math.max(1, ...places.map(([x, y]) => Math.hypot(x, y))) + 0.3;
  const svg = shape("svg", { viewBox: `${-size / 2} ${-size / 2} ${size} ${size}`, role: "img", "aria-label": "Lamps, seen from the camera" });
  for (const degrees of [30, 60, 90]) svg.append(shape("circle", { r: degrees / 90, class: "ring" }));
  const radius = Math.min(0.06, 0.8 / Math.sqrt(lamps.length));
  const dots = places.map(([x, y]) => shape("circle", { cx: x, cy: y, r: radius, stroke: "var(--soft)", "stroke-width": 0.006 }));
  const titles = dots.map(() => shape("title", {}));
  dots.forEach((dot, index) => {
    dot.append(titles[index]);
    if (choose !== null) dot.addEventListener("click", () => choose(index));
  });
  svg.append(...dots);
  parent.replaceChildren(svg);
  return ({ colours, levels, words = null }) => colours.forEach((colour, index) => {
    const code = colour.map((value) => Math.round(255 * Math.min(1, Math.max(0, value)) ** (1 / 2.2)));
    dots[index].setAttribute("fill", `rgb(${code})`);
    titles[index].textContent = `${lamps[index].name}: ${words?.[index] ?? levels[index].map((level) => `${(100 * level).toFixed(1)} %`).join(", ")}`;
  });
}

function label(degrees) {
  const text = shape("text", { x: 0, y: -degrees / 90 - 0.015, class: "degrees" });
  text.textContent = `${degrees}°`;
  return text;
}

function shape(name, attributes) {
  const made = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, String(value));
  return made;
}
