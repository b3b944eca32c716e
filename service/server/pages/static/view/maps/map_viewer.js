/** Layers of a view as an image that can be zoomed and compared, with the value under the cursor. */

import { element, numberOf, tell } from "../../element.js";
import { ControlAddress } from "../control_address.js";
import { COLOUR_MAPS, VIEW_TRANSFORM } from "../display.js";
import { mountHistogram, short } from "./histogram.js";
import { drawAxes } from "./map_axes.js";
import { MapPlace, ZOOM } from "./map_place.js";
import { codeWords, OUTSIDE, REFUSED, stateOf, UNSURE } from "./pixel_states.js";
import { TiledImage } from "./tiled_image.js";

const STATE_WORDS = { [UNSURE]: "unsure: the value is not vouched for", [REFUSED]: "refused", [OUTSIDE]: "outside the object" };
const PAN = 0.1; // of the canvas, for one press of an arrow key
const NONE = "";
const OVERLAID = /^confidence$|^(\w+_)?sigma(_\w+)?$/; // names of layers that say how sure others are
const WAYS = { wipe: "by a wipe", difference: "as the difference of their colours", beside: "side by side" };

/**
 * Show the layers of a view.
 * @param {HTMLElement} parent Takes the viewer.
 * @param {import("../view_file.js").ViewFile} view
 * @param {{onpick?: function(number, number): void, others?: {name: string, view: import("../view_file.js").ViewFile}[]}} [options] `onpick` is called with row and
 *     column of a pixel that was chosen; `others` are views of the same pixels, to compare with, the first of which is at first.
 * @returns {{destroy: function(): void}}
 */
export function mount(parent, view, { onpick = () => {}, others = [] } = {}) {
  const canvas = element("canvas", { class: "map", tabindex: 0, role: "img",
    "aria-label": "Map. Plus and minus zoom, arrow keys move, 0 shows all, Enter chooses the pixel in the middle." });
  const context = canvas.getContext("2d");
  const value = element("output", { class: "value", "aria-live": "polite" }, "Point at a pixel to read its values.");
  const [histogram, overHistogram] = [element("div", { class: "histogram" }), element("div", { class: "histogram" })];
  const layerSelect = layerChoice("Layer");
  const otherSelect = layerChoice("Compare with", true);
  otherSelect.append(...others.map(({ name, view: { info } }, at) => element("optgroup", { label: name },
    ...info.layers.map((layer) => element("option", { value: `${at}/${layer.name}` }, `${layer.title} of ${name}`)))));
  const overSelect = element("select", {}, element("option", { value: NONE }, "nothing"),
    ...view.info.layers.filter(({ kind, name }) => kind === "scalar" && OVERLAID.test(name)).map(({ name, title }) => element("option", { value: name }, title)));
  const axes = checkbox(true);
  const how = element("select", {}, ...Object.entries(WAYS).map(([value, text]) => element("option", { value }, text)));
  const wipe = element("input", { type: "range", min: 0, max: 100, value: 50, "aria-label": "Where the two layers meet" });
  const colours = element("select", {}, ...COLOUR_MAPS.map((name) => element("option", { value: name }, name)));
  const stops = element("input", { type: "range", min: -6, max: 6, step: 0.1, value: 0, "aria-label": "Exposure in stops" });
  const hatched = { unsure: checkbox(true), refused: checkbox(true) };
  const named = (text, control, ...more) => element("label", {}, `${text} `, control, ...more);
  const colourRow = named("Colour map", colours);
  const stopsRow = named("Exposure (stops)", stops, numberOf(stops));
  const [wipeRow, howRow] = [named("Wipe (%)", wipe, numberOf(wipe)), named("How", how)];
  const panel = element("div", { class: "panel" }, named("Layer", layerSelect), named("Compare with", otherSelect), howRow, wipeRow,
    overSelect.options.length > 1 ? named("Grey out by", overSelect) : null, overHistogram,
    named("Rows and columns", axes), named("Hatch unsure pixels", hatched.unsure), named("Hatch refused pixels", hatched.refused), colourRow, stopsRow, histogram,
    element("p", { class: "actions" }, button("Zoom in", () => map.zoom(ZOOM)), button("Zoom out", () => map.zoom(1 / ZOOM)), button("Show all", () => map.fit())),
    element("p", { class: "help" }, `Colours are shown through ${VIEW_TRANSFORM}.`));
  parent.replaceChildren(element("div", { class: "viewer" }, element("div", { class: "stage" }, canvas, value), panel));

  const map = new MapPlace(canvas, view.info, { isBeside: beside, changed: draw });
  let image = null;
  let other = null;
  let over = null; // a grey veil over the image, where this says that values are unsure
  let asked = false;
  let looked = 0;

  function layerChoice(name, none = false) {
    return element("select", { "aria-label": name }, none ? element("option", { value: NONE }, "nothing") : null,
      ...view.info.layers.map((layer) => element("option", { value: layer.name }, layer.title)));
  }

  function checkbox(checked) {
    return element("input", { type: "checkbox", checked });
  }

  function button(text, action) {
    return element("button", { type: "button", class: "quiet", onclick: action }, text);
  }

  function draw() {
    if (asked) return;
    asked = true;
    requestAnimationFrame(() => {
      asked = false;
      const { width, height } = canvas;
      const place = map.now;
      context.clearRect(0, 0, width, height);
      const marks = { unsure: hatched.unsure.checked, refused: hatched.refused.checked };
      const way = other === null ? null : how.value;
      const border = { wipe: Math.round((width * Number(wipe.value)) / 100), beside: Math.round(width / 2) }[way] ?? width;
      const shift = beside() ? width / 4 : 0; // each stands in the middle of its half
      image.draw(context, { ...place, x: place.x - shift }, { left: 0, right: border }, marks);
      if (way === "difference") context.globalCompositeOperation = "difference";
      other?.draw(context, { ...place, x: place.x + shift }, { left: way === "difference" ? 0 : border, right: width }, marks);
      context.globalCompositeOperation = "source-over";
      over?.draw(context, { ...place, x: place.x - shift }, { left: 0, right: border }, {});
      if (axes.checked) {
        const [ink, paper] = ["color", "outlineColor"].map((name) => getComputedStyle(canvas)[name]);
        drawAxes(context, { ...place, x: place.x - shift }, view.info, { left: 0, right: beside() ? border : width }, { ink, paper });
        if (beside()) drawAxes(context, { ...place, x: place.x + shift }, view.info, { left: border, right: width }, { ink, paper });
      }
      if (border < width) {
        context.fillStyle = getComputedStyle(canvas).color;
        context.fillRect(border - 1, 0, 2, height);
      }
    });
  }

  function select() {
    const look = { colours: colours.value, stops: Number(stops.value) };
    const failed = (error) => tell(error.message);
    const made = (chosen) => {
      const [at, name] = chosen.includes("/") ? chosen.split("/") : [null, chosen];
      const from = at === null ? view : others[Number(at)].view;
      return new TiledImage(from, from.layer(name), draw, failed);
    };
    image = made(layerSelect.value);
    other = otherSelect.value === NONE ? null : made(otherSelect.value);
    over = overSelect.value === NONE ? null : new TiledImage(view, view.layer(overSelect.value), draw, failed);
    over?.setLook({ veil: over.layer.name === "confidence" ? "low" : "high" });
    for (const each of [image, other]) each?.setLook(look);
    const kinds = [image, other].map((each) => each?.layer.kind);
    colourRow.hidden = !kinds.includes("scalar") && !kinds.includes("mask");
    stopsRow.hidden = !kinds.includes("colour");
    howRow.hidden = other === null;
    wipeRow.hidden = other === null || how.value !== "wipe";
    mountHistogram(histogram, image.layer, view.info.codes, image.look, (range) => image.setLook(range));
    if (over === null) overHistogram.replaceChildren();
    else mountHistogram(overHistogram, over.layer, view.info.codes, over.look, (range) => over.setLook(range), " by the grey");
    draw();
  }

  function beside() {
    return other !== null && how.value === "beside";
  }

  async function read(x, y) {
    const mine = ++looked;
    const pixel = map.pixelAt(x, y);
    if (pixel === null) return;
    const shown = [image, other, over].filter((each) => each !== null && each.layer.name !== "status");
    const asked = [view.layer("status"), view.layer("mask")].map((layer) => (layer === undefined ? null : view.pixel(layer, ...pixel)));
    let found;
    try {
      found = await Promise.all([...asked, ...shown.map((each) => each.pixel(...pixel))]);
    } catch (error) {
      tell(error.message);
      return;
    }
    if (mine !== looked) return;
    const [status, mask, ...values] = found;
    const parts = shown.map(({ layer }, at) => `${layer.title} ${words(layer, values[at])}`);
    const code = status?.[0];
    const state = mask === null ? undefined : STATE_WORDS[stateOf(view.info.codes, code, mask[0])];
    if (code !== undefined && state !== STATE_WORDS[OUTSIDE]) parts.push(`status: ${codeWords(view.info.codes, code)}`);
    if (state !== undefined) parts.push(state);
    value.textContent = `row ${pixel[0]}, column ${pixel[1]}: ${parts.join("; ")}`;
  }

  function words(layer, values) {
    return values.map(short).join(", ") + (layer.unit === null ? "" : ` ${layer.unit}`);
  }

  map.listen({ pointed: read, clicked: pick });

  function pick(x, y) {
    const pixel = map.pixelAt(x, y);
    if (pixel !== null) onpick(...pixel);
  }

  function pan(x, y) {
    map.pan(x * canvas.width, y * canvas.height);
    read(canvas.width / 2, canvas.height / 2);
  }

  const keys = {
    "+": () => map.zoom(ZOOM), "=": () => map.zoom(ZOOM), "-": () => map.zoom(1 / ZOOM), 0: () => map.fit(),
    ArrowLeft: () => pan(PAN, 0), ArrowRight: () => pan(-PAN, 0), ArrowUp: () => pan(0, PAN), ArrowDown: () => pan(0, -PAN),
    Enter: () => pick(canvas.width / 2, canvas.height / 2),
  };
  canvas.addEventListener("keydown", (event) => {
    if (!(event.key in keys)) return;
    event.preventDefault();
    keys[event.key]();
  });
  if (others.length > 0) otherSelect.value = `0/${(others[0].view.layer(layerSelect.value) ?? others[0].view.info.layers[0]).name}`;
  const address = new ControlAddress({ layer: layerSelect, with: otherSelect, over: overSelect, how, "map-wipe": wipe, colours, "map-stops": stops });
  address.read();
  for (const each of [stops, wipe]) each.dispatchEvent(new Event("set"));
  panel.addEventListener("input", () => address.write());
  for (const each of [layerSelect, otherSelect, overSelect, how]) each.addEventListener("change", select);
  how.addEventListener("change", () => map.fit());
  wipe.addEventListener("input", draw);
  axes.addEventListener("change", draw);
  for (const each of Object.values(hatched)) each.addEventListener("change", draw);
  colours.addEventListener("change", () => [image, other].forEach((each) => each?.setLook({ colours: colours.value })));
  stops.addEventListener("input", () => [image, other].forEach((each) => each?.setLook({ stops: Number(stops.value) })));
  const resized = new ResizeObserver(() => {
    const box = canvas.getBoundingClientRect();
    const ratio = globalThis.devicePixelRatio ?? 1;
    const size = [box.width, box.height].map((side) => Math.round(side * ratio));
    if (Math.min(...size) === 0 || (size[0] === canvas.width && size[1] === canvas.height)) return; // hidden, or shown again as it was left
    [canvas.width, canvas.height] = size;
    map.restore();
  });
  select();
  map.restore();
  resized.observe(canvas);
  return { destroy: () => resized.disconnect() };
}
