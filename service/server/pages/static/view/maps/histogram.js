/** The histogram of a layer, with two handles for the range of values that is shown. */

import { element } from "../../element.js";
import { codeColour } from "../display.js";
import { codeWords } from "./pixel_states.js";

const COLOURS = ["#d5524a", "#3f9b54", "#4a78d5"];
const HEIGHT = 72;
const WIDTH = 256;
const STEPS = 1000;

/**
 * Show a histogram.
 * @param {HTMLElement} parent Takes it.
 * @param {any} layer Of view.json.
 * @param {any} codes Of view.json.
 * @param {{low: number, high: number, codes: number[]}} look What is shown now.
 * @param {function({low: number, high: number}): void} changed Called with another range.
 * @param {string} [which] Ends the names of its controls where a page has several.
 */
export function mountHistogram(parent, layer, codes, look, changed, which = "") {
  if (layer.kind === "mask") { // its histogram counts codes
    parent.replaceChildren();
    return;
  }
  if (layer.kind === "codes") {
    const names = layer.name === "status" ? (code) => codeWords(codes, code) : (code) => layer.codes?.[code]?.name ?? `${layer.title} ${code}`;
    parent.replaceChildren(element("ul", { class: "plain legend" }, ...look.codes.filter((code) => code !== 0).map((code) => legend(codeColour(look.codes, code), names(code)))));
    return;
  }
  const { low, high, counts } = layer.histogram;
  const canvas = element("canvas", { width: WIDTH, height: HEIGHT, role: "img", "aria-label": `Histogram of ${layer.title} from ${short(low)} to ${short(high)}` });
  const context = canvas.getContext("2d");
  const highest = Math.max(1, ...counts.flat());
  counts.forEach((channel, index) => {
    context.fillStyle = counts.length === 1 ? getComputedStyle(parent).color : COLOURS[index];
    context.globalAlpha = counts.length === 1 ? 0.7 : 0.5;
    channel.forEach((count, bin) => {
      const height = HEIGHT * Math.sqrt(count / highest); // the root, so that rare values are seen too
      context.fillRect((bin * WIDTH) / channel.length, HEIGHT - height, WIDTH / channel.length, height);
    });
  });
  const children = [canvas, element("p", { class: "axis" }, ...[low, (low + high) / 2, high].map((value) => element("span", {}, short(value))))];
  if (layer.kind === "scalar") {
    const toValue = (step) => low + ((high - low) * step) / STEPS;
    const toStep = (value) => Math.round((STEPS * (value - low)) / (high - low || 1));
    const text = element("output", {}, rangeText(look));
    const handle = (name, value) => element("input", { type: "range", min: 0, max: STEPS, value: toStep(value), "aria-label": name });
    const from = handle(`Lowest value that is shown${which}`, look.low);
    const to = handle(`Highest value that is shown${which}`, look.high);
    const update = (moved) => {
      if (Number(from.value) >= Number(to.value)) {
        if (moved === from) to.value = String(Math.min(STEPS, Number(from.value) + 1));
        else from.value = String(Math.max(0, Number(to.value) - 1));
      }
      const range = { low: toValue(Number(from.value)), high: toValue(Number(to.value)) };
      text.textContent = rangeText(range);
      changed(range);
    };
    from.addEventListener("input", () => update(from));
    to.addEventListener("input", () => update(to));
    children.push(from, to, text);
  }
  parent.replaceChildren(...children);

  function rangeText(range) {
    return `${short(range.low)} to ${short(range.high)}${layer.unit === null ? "" : ` ${layer.unit}`}`;
  }
}

function legend(colour, words) {
  const sample = element("span", { class: "sample" });
  sample.style.backgroundColor = `rgb(${colour.join(" ")})`;
  return element("li", {}, sample, " ", words);
}

/** Return a number with four significant digits. */
export function short(value) {
  return Number(value.toPrecision(4)).toString().replace("-", "−");
}
