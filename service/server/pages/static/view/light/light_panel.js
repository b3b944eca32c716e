/** The controls of live relighting. */

import { element, numberOf } from "../../element.js";
import { VIEW_TRANSFORMS } from "../view_transforms.js";

/**
 * Return the controls by name, the panel that they stand in, and the places of it that change.
 * @param {any} relight Of view.json.
 * @param {any[]} lights Frames of view.json with one light each.
 * @param {{id: string, name: string}[]} environments Of the server.
 */
export function lightPanel(relight, lights, environments) {
  const control = {
    lit: element("input", { type: "checkbox", checked: true }),
    brightness: range("Brightness of the light", -6, 6, 0.1, 0), colour: element("input", { type: "color", value: "#ffffff" }),
    size: range("Size of the light in degrees", 0, 90, 0.5, 0.5), environment: element("select", { "aria-label": "Environment map" }, element("option", { value: "" }, "none"),
      ...environments.map(({ id, name }) => element("option", { value: id }, name))),
    file: element("input", { type: "file", accept: ".exr,.hdr", class: "visually-hidden" }),
    environmentStops: range("Brightness of the environment", -10, 10, 0.1, 0), turn: range("Turn of the environment in degrees", 0, 360, 0.1, 0),
    exposure: range("Exposure in stops", -10, 10, 0.1, 0),
    view: element("select", { "aria-label": "View transform" }, ...Object.entries(VIEW_TRANSFORMS).map(([value, text]) => element("option", { value }, text))),
    compare: element("select", { "aria-label": "Photograph to compare with" }, element("option", { value: "" }, "nothing"),
      ...lights.map((frame, index) => element("option", { value: index }, frame.image))),
    wipe: range("Where the two pictures meet", 0, 100, 1, 50),
  };
  const [dome, preview] = [element("div"), element("div")];
  const speed = element("p", { class: "help", "data-shows": "speed" }, `${sizeOf(relight)}.`);
  const play = element("button", { type: "button", class: "quiet", "aria-pressed": "false" }, "Spin");
  const expose = element("button", { type: "button", class: "quiet" }, "Expose for this light");
  const row = (text, each) => element("label", {}, `${text} `, each, each.type === "range" ? numberOf(each) : null);
  const wipeRow = row("Wipe", control.wipe);
  const panel = element("div", { class: "panel" },
    element("fieldset", {}, element("legend", {}, "Light"), row("On", control.lit), dome, row("Brightness (stops)", control.brightness),
      row("Colour", control.colour), row("Size (degrees)", control.size)),
    element("fieldset", {}, element("legend", {}, "Environment"), row("Map", control.environment),
      element("label", { class: "button quiet" }, "Open a file", control.file), preview, row("Brightness (stops)", control.environmentStops),
      row("Turn (degrees)", control.turn), play),
    element("fieldset", {}, element("legend", {}, "Picture"), row("Exposure (stops)", control.exposure), expose, row("View", control.view),
      row("Compare with the photograph", control.compare), wipeRow),
    element("details", { class: "figures" }, element("summary", {}, "How exact, how fast"), element("p", { class: "help" }, errorOf(relight)), speed));
  return { control, panel, dome, preview, speed, play, expose, wipeRow };
}

/** Return how large the coefficient images are. */
export function sizeOf({ terms, rows, cols }) {
  return `${terms} coefficient images of ${((rows * cols) / 1e6).toPrecision(2)} megapixels`;
}

/** Return what a basis leaves, as measured when it was made. */
function errorOf({ held_out: held, relative_rms: captured }) {
  const levels = (value) => value.toPrecision(2);
  return `Against relit relight, under ${held.key_lights} lights that the basis was not made from: ${levels(held.mean_levels)} of 255 levels off on average, ${levels(held.largest_levels)} under the worst of them, ${levels(held.even_sky_levels)} under light from all around. It keeps the captured images within ${(100 * captured).toPrecision(2)} % (RMS). A view job with more terms is closer.`;
}

function range(name, low, high, step, value) {
  return element("input", { type: "range", min: low, max: high, step, value, "aria-label": name });
}
