/** The readings of one pixel under every light, against the model that was fitted to them. */

import { element } from "../../element.js";
import { short } from "./histogram.js";
import { floats } from "../view_file.js";

const SVG = "http://www.w3.org/2000/svg";
const [WIDTH, HEIGHT, LEFT, BOTTOM, TOP] = [640, 240, 48, 24, 8];
const CHANNELS = ["red", "green", "blue"];
const BYTES = 6; // three half floats

/**
 * Make a plot that shows pixels of a view.
 * @param {HTMLElement} parent Takes it.
 * @param {import("../view_file.js").ViewFile} view
 * @returns {{show: function(number, number): Promise<void>}|null} Null: the view has no readings.
 */
export function mount(parent, view) {
  const { samples } = view.info;
  if (samples === null) {
    parent.replaceChildren(element("p", { class: "help" }, "There are no readings to plot: the maps were not solved from lights."));
    return null;
  }
  const frames = view.info.frames.filter((frame) => frame.direction !== null);
  const order = element("select", {}, element("option", { value: "light" }, "number of the light"), element("option", { value: "angle" }, "angle to the normal"));
  const place = element("div", {}, element("p", { class: "help" }, "Choose a pixel of the map: click it, or press Enter."));
  parent.replaceChildren(element("label", {}, "Order by ", order), place);
  let shown = null;
  let asked = null; // the pixel that was chosen last, whose readings may still come
  order.addEventListener("change", () => shown !== null && present(shown));

  async function show(row, col) {
    const mine = { row, col };
    asked = mine;
    const at = Math.min(Math.floor(row / samples.step), samples.rows - 1) * samples.cols + Math.min(Math.floor(col / samples.step), samples.cols - 1);
    const size = samples.lights * BYTES;
    const read = async (offset, bytes) => (offset === null ? null : view.raw(offset + at * bytes, bytes));
    const [measured, model, used, normal] = await Promise.all([read(samples.measured, size), read(samples.model, size),
      read(samples.used ?? null, samples.lights), view.layer("normal") === undefined ? null : view.pixel(view.layer("normal"), row, col)]);
    if (mine !== asked) return;
    const radiance = (block) => floats(block, "float16").map((value) => samples.scale * value);
    shown = { row, col, measured: radiance(measured), model: model === null ? null : radiance(model),
      used: used === null ? null : new Uint8Array(used), normal };
    present(shown);
  }

  function present({ row, col, measured, model, used, normal }) {
    const angle = (index) => {
      const { direction } = frames[index] ?? {};
      if (normal === null || direction === null || direction === undefined) return NaN;
      return (180 / Math.PI) * Math.acos(Math.max(-1, Math.min(1, direction.reduce((sum, each, c) => sum + each * normal[c], 0))));
    };
    const lights = [...Array(samples.lights).keys()];
    if (order.value === "angle") lights.sort((a, b) => angle(a) - angle(b));
    const svg = shape("svg", { viewBox: `0 0 ${WIDTH} ${HEIGHT}`, role: "img", class: "plot",
      "aria-label": `Readings of row ${row}, column ${col} under ${samples.lights} lights; a table with the numbers follows` });
    const highest = Math.max(...measured, ...(model ?? [0]), 1e-6);
    const x = (position) => LEFT + ((position + 0.5) * (WIDTH - LEFT)) / samples.lights;
    const y = (value) => HEIGHT - BOTTOM - (Math.max(0, value) * (HEIGHT - BOTTOM - TOP)) / highest;
    for (const part of [0, 0.5, 1]) {
      svg.append(shape("line", { x1: LEFT, x2: WIDTH, y1: y(part * highest), y2: y(part * highest), class: "grid" }));
      svg.append(text(LEFT - 6, y(part * highest) + 4, short(part * highest), "end"));
    }
    svg.append(text((LEFT + WIDTH) / 2, HEIGHT - 6, order.value === "angle" ? "lights by their angle to the normal" : "lights by their number", "middle"));
    CHANNELS.forEach((name, channel) => {
      if (model !== null) {
        const points = lights.map((light, at) => `${x(at)},${y(model[3 * light + channel])}`).join(" ");
        svg.append(shape("polyline", { points, class: `model ${name}` }));
      }
      lights.forEach((light, at) => {
        const left = used !== null && used[light] !== 0;
        svg.append(shape("circle", { cx: x(at), cy: y(measured[3 * light + channel]), r: 2.6, class: `${left ? "left-out " : ""}measured ${name}` }));
      });
    });
    const rows = lights.map((light) => element("tr", {}, element("td", {}, frames[light]?.image ?? String(light)), element("td", {}, Number.isNaN(angle(light)) ? "–" : `${angle(light).toFixed(1)}°`),
      element("td", {}, triple(measured, light)), element("td", {}, model === null ? "–" : triple(model, light)), element("td", {}, words(used, light))));
    const heads = ["Light", "Angle to the normal", "Measured", "Model", "Remark"].map((name) => element("th", { scope: "col" }, name));
    place.replaceChildren(element("h3", {}, `Row ${row}, column ${col}`), svg,
      element("p", { class: "help" }, "Dots: measured radiance. Lines: the fitted model. Hollow dots: readings that are clipped, in shadow or lit from behind.",
        samples.step > 1 ? ` Readings of every ${ordinal(samples.step)} pixel are kept; this is the nearest.` : ""),
      element("details", {}, element("summary", {}, "The numbers"), element("table", {}, element("thead", {}, element("tr", {}, ...heads)), element("tbody", {}, ...rows))));
  }

  function words(used, light) {
    if (used === null || used[light] === 0) return "";
    return Object.entries(samples.codes ?? {}).filter(([bit]) => used[light] & Number(bit)).map(([, meaning]) => meaning.name ?? meaning).join(", ");
  }

  return { show };
}

function ordinal(number) {
  return `${number}${{ 2: "nd", 3: "rd" }[number] ?? "th"}`; // no step is above twenty
}

function triple(values, light) {
  return [0, 1, 2].map((channel) => short(values[3 * light + channel])).join(", ");
}

function text(x, y, content, anchor) {
  const made = shape("text", { x, y, "text-anchor": anchor });
  made.textContent = content;
  return made;
}

function shape(name, attributes) {
  const made = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, String(value));
  return made;
}
