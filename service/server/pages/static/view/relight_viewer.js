/** Relights a capture live: a key light that is dragged, an environment that is spun, and captured lights to compare with. */

import { element, numberOf, tell } from "../element.js";
import { ViewState } from "../publish/view_state.js";
import { BasisRenderer, canRender } from "./basis_renderer.js";
import { converted, DISPLAY_SPACE, matrixBetween } from "./colour_spaces.js";
import { ControlAddress } from "./control_address.js";
import { VIEW_TRANSFORM } from "./display.js";
import { mountDomeControl } from "./dome_control.js";
import { previewOf, readEnvironment } from "./environment_map.js";
import { EnvironmentProfile, LightModel, unit } from "./light_model.js";
import { floats } from "./view_file.js";
import { mountZoomed } from "./zoomed_picture.js";

const BEYOND_SHARE = 0.05; // from which the commands warn too
const SPIN_DEGREES_PER_S = 30;
const FIRST_LIGHT = [0.45, 0.5, 0.74]; // above right of the camera
const BACKDROP = 0.2; // encoded grey around the object, the same in light and dark, since colours are judged before it
const WHITE_PERCENTILE = 0.99;
const SAMPLES = 2000; // pixels that the first exposure is taken from
const NO_WEBGL = "This browser has no WebGL2, which live relighting needs. The frames can still be made by a job, and the captured images looked at.";

/**
 * Show the live relighting of a view.
 * @param {HTMLElement} parent Takes it.
 * @param {import("./view_file.js").ViewFile} view With `relight`.
 * @param {{environments: {id: string, name: string}[], load: function(string): Promise<{name: string, data: ArrayBuffer}>,
 *          onchange: function(any): void, embedded?: boolean}} options Environments of the server and how their files are read; `onchange` is told the
 *     light; `embedded`: the page moves the light, and the address is its own.
 * @returns {Promise<{destroy: function(): void, state: function(): any, pixels: function(): Uint8Array, set: function(any): void,
 *     canvas: HTMLCanvasElement|null, over: object|null, turn: function(number): void}>} `over` is that of zoomed_picture.js; `turn` turns the environment by degrees, or the light where there is none.
 */
export async function mount(parent, view, { environments, load, onchange, embedded = false }) {
  const { relight } = view.info;
  if (!canRender()) {
    parent.replaceChildren(element("p", { class: "fault" }, NO_WEBGL));
    return { destroy: () => {}, state: () => null, pixels: () => null, set: () => {}, canvas: null, over: null, turn: () => {} };
  }
  const lights = view.info.frames.filter((frame) => frame.direction !== null);
  const place = new ViewState({ width: relight.cols, height: relight.rows }, embedded ? {} : { light: 3, centre: 2, zoom: 1 }, FIRST_LIGHT);
  const drawn = element("canvas", { width: relight.cols, height: relight.rows });
  const warning = element("p", { class: "beyond", role: "status", hidden: true });
  const dome = element("div");
  const preview = element("div");
  const control = {
    lit: element("input", { type: "checkbox", checked: true }),
    brightness: range("Brightness of the light", -6, 6, 0.1, 0), colour: element("input", { type: "color", value: "#ffffff" }),
    size: range("Size of the light in degrees", 0, 90, 0.5, 0.5), environment: element("select", { "aria-label": "Environment map" }, element("option", { value: "" }, "none"),
      ...environments.map(({ id, name }) => element("option", { value: id }, name))),
    file: element("input", { type: "file", accept: ".exr,.hdr", class: "visually-hidden" }),
    environmentStops: range("Brightness of the environment", -10, 10, 0.1, 0), turn: range("Turn of the environment in degrees", 0, 360, 0.1, 0),
    exposure: range("Exposure in stops", -10, 10, 0.1, 0),
    compare: element("select", { "aria-label": "Photograph to compare with" }, element("option", { value: "" }, "nothing"),
      ...lights.map((frame, index) => element("option", { value: index }, frame.image))),
    wipe: range("Where the two pictures meet", 0, 100, 1, 50),
  };
  const speed = element("p", { class: "help", "data-shows": "speed" }, `${sizeOf(relight)}.`);
  const play = element("button", { type: "button", class: "quiet", "aria-pressed": "false" }, "Spin");
  const row = (text, each) => element("label", {}, `${text} `, each, each.type === "range" ? numberOf(each) : null);
  const wipeRow = row("Wipe", control.wipe);
  const panel = element("div", { class: "panel" },
    element("fieldset", {}, element("legend", {}, "Light"), row("On", control.lit), dome, row("Brightness (stops)", control.brightness),
      row("Colour", control.colour), row("Size (degrees)", control.size)),
    element("fieldset", {}, element("legend", {}, "Environment"), row("Map", control.environment),
      element("label", { class: "button quiet" }, "Open a file", control.file), preview, row("Brightness (stops)", control.environmentStops),
      row("Turn (degrees)", control.turn), play),
    element("fieldset", {}, element("legend", {}, "Picture"), row("Exposure (stops)", control.exposure),
      element("button", { type: "button", class: "quiet", onclick: () => { expose(); change(); } }, "Expose for this light"), row("Compare with the photograph", control.compare), wipeRow,
      element("p", { class: "help" }, `Shown through ${VIEW_TRANSFORM}.`)),
    element("fieldset", { class: "figures" }, element("legend", {}, "How exact, how fast"), element("p", { class: "help" }, errorOf(relight)), speed));
  const stage = element("div", { class: "stage" });
  parent.replaceChildren(element("div", { class: "viewer" }, stage, panel));
  const pixelSize = view.info.camera.pixel_size_m ? view.info.camera.pixel_size_m * relight.step : null;
  const zoomed = mountZoomed(stage, drawn, place, { changed: onGesture, pixelSize, still: embedded });
  const { canvas } = zoomed;
  stage.append(warning);

  const { quadrature } = relight;
  const [inverse, beyond, outside, captured, index] = await Promise.all([quadrature.inverse, quadrature.beyond, quadrature.outside, relight.captured, relight.tiles.index].map((block) => view.block(block)));
  const model = new LightModel(relight, { inverse: new Float64Array(inverse), beyond: new Float32Array(beyond), outside: new Float32Array(outside), captured: floats(captured, "float16") }, lights);
  const tiles = new Uint16Array(index);
  const renderer = new BasisRenderer(drawn, relight, view.info.color_space, tiles);
  const matte = new Uint8Array(await view.block(relight.matte));
  renderer.setMatte(matte);
  const unitIrradiance = Math.max(...(lights[0]?.irradiance ?? [1]));
  const fromDisplay = matrixBetween(DISPLAY_SPACE, view.info.color_space);
  let map = null; // { id, name, profile }
  let asked = false;
  const domeControl = mountDomeControl(dome, model, lights.map((frame) => frame.direction), move);

  const address = embedded ? null : new ControlAddress({ on: control.lit, brightness: control.brightness, colour: control.colour, size: control.size,
    environment: control.environment, "environment-stops": control.environmentStops, turn: control.turn, stops: control.exposure,
    compare: control.compare, wipe: control.wipe });
  const given = address?.read() ?? [];

  function move(direction) {
    place.set({ light: direction });
    control.lit.checked = true;
    change();
  }

  /** Do what a gesture on the picture asks for: a place of the unit disc is a direction towards the camera. */
  function onGesture(changes) {
    if (changes.light === undefined) {
      place.set(changes);
      zoomed.draw();
      return;
    }
    const across = Math.hypot(...changes.light);
    const [x, y] = changes.light.map((each) => each / Math.max(across, 1));
    move([x, y, Math.sqrt(Math.max(0, 1 - x * x - y * y))]);
  }

  /** Return the light as the batch takes it. */
  function state() {
    const linear = [1, 3, 5].map((at) => decoded(parseInt(control.colour.value.slice(at, at + 2), 16) / 255));
    const gain = unitIrradiance * 2 ** Number(control.brightness.value);
    return {
      light: control.lit.checked ? { direction: place.light, irradiance: linear.map((each) => gain * each), angle_degrees: Number(control.size.value) } : null,
      environment: map === null ? null : { id: map.id, name: map.name, turn_degrees: Number(control.turn.value), exposure: Number(control.environmentStops.value) },
      exposure: Number(control.exposure.value),
    };
  }

  function change() {
    for (const each of Object.values(control)) each.dispatchEvent(new Event("set"));
    domeControl.set(control.lit.checked ? place.light : null);
    address?.write();
    wipeRow.hidden = control.compare.value === "";
    onchange(state());
    if (asked) return;
    asked = true;
    requestAnimationFrame(() => {
      asked = false;
      draw();
    });
  }

  function draw() {
    const now = state();
    const sum = sumOf(now);
    const shown = model.coefficients(sum);
    const chosen = control.compare.value;
    const compared = chosen === "" ? null : model.capturedImage(Number(chosen));
    renderer.draw({ shown, compared, border: Number(control.wipe.value) / 100, gain: 2 ** now.exposure, backdrop: [BACKDROP, BACKDROP, BACKDROP] });
    zoomed.draw(`rgb(${Array(3).fill(Math.round(255 * BACKDROP))})`);
    const { framesPerSecond, gpuMs } = renderer.timer.figures();
    if (framesPerSecond !== null) speed.textContent = `${sizeOf(relight)}: ${framesPerSecond.toFixed(0)} pictures a second${gpuMs === null ? "" : `, ${gpuMs.toPrecision(2)} ms each on the graphics processor`}.`;
    const share = model.shareBeyond(sum);
    warning.hidden = share < BEYOND_SHARE;
    canvas.classList.toggle("hatched", share >= BEYOND_SHARE);
    warning.textContent = warning.hidden ? "" : `${Math.round(100 * share)} % of the light comes from beyond the captured lights (more than ${relight.beyond_degrees.toFixed(0)}° from each): the nearest of them stand in for it, with their own shading and shadows.`;
  }

  /** Set the exposure at which all but the brightest pixels of the picture are below white. */
  function expose() {
    const coefficients = model.coefficients(sumOf(state()));
    const levels = covered.map((place, index) => {
      const from = 3 * relight.terms * tileOf(place, relight, tiles);
      return Math.max(...[0, 1, 2].map((c) => terms.reduce((sum, term, k) => sum + coefficients[from + 3 * k + c] * term[3 * index + c], 0)));
    });
    const white = levels.sort((a, b) => a - b)[Math.floor(WHITE_PERCENTILE * (levels.length - 1))];
    if (white > 0) control.exposure.value = String(Math.round(-10 * Math.log2(white)) / 10);
  }

  function sumOf(now) {
    const key = now.light === null ? null : { ...now.light, irradiance: converted(fromDisplay, now.light.irradiance) };
    return model.sum(key, map === null ? null : model.turned(map.profile, now.environment.turn_degrees, 2 ** now.environment.exposure));
  }

  async function useEnvironment(id, name, data) {
    const found = await readEnvironment(data, name, view.info.color_space);
    map = { id, name, profile: new EnvironmentProfile(found, model.rows) };
    preview.replaceChildren(previewOf(found));
    change();
  }

  /** Show an environment alone at first, exposed for it; the key light comes back when it is moved or switched on. */
  async function chooseEnvironment(id, name, data) {
    const isFirst = map === null;
    await useEnvironment(id, name, data);
    if (isFirst) control.lit.checked = false;
    expose();
    change();
  }

  function dropEnvironment() {
    control.lit.checked = true;
    map = null;
    preview.replaceChildren();
    change();
  }

  drawn.addEventListener("webglcontextlost", () => tell("The graphics processor has stopped drawing.", "fault", () => location.reload()));
  for (const each of [control.lit, control.brightness, control.colour, control.size, control.environmentStops, control.turn, control.exposure, control.wipe, control.compare]) {
    each.addEventListener("input", change);
  }
  control.environment.addEventListener("change", () => attemptHere(async () => {
    const id = control.environment.value;
    if (id === "") dropEnvironment();
    else {
      const { name, data } = await load(id);
      await chooseEnvironment(id, name, data);
    }
  }));
  control.file.addEventListener("change", () => attemptHere(async () => {
    const [file] = control.file.files;
    if (file === undefined) return;
    control.environment.value = "";
    await chooseEnvironment(null, file.name, await file.arrayBuffer());
  }));
  function turn(degrees) {
    if (map !== null) {
      control.turn.value = String((Number(control.turn.value) + degrees + 360) % 360);
      change();
      return;
    }
    const [x, y, z] = place.light;
    const [cos, sin] = [Math.cos((degrees * Math.PI) / 180), Math.sin((degrees * Math.PI) / 180)];
    move([x * cos - y * sin, x * sin + y * cos, z]); // around the view axis, so that it stays among the captured lights
  }

  let spinning = null;
  play.addEventListener("click", () => {
    play.setAttribute("aria-pressed", String(spinning === null));
    if (spinning !== null) {
      cancelAnimationFrame(spinning);
      spinning = null;
      return;
    }
    let before = performance.now();
    const step = (time) => {
      turn(((time - before) / 1000) * SPIN_DEGREES_PER_S);
      before = time;
      spinning = requestAnimationFrame(step);
    };
    spinning = requestAnimationFrame(step);
  });

  const covered = spread(matte, SAMPLES);
  const terms = await Promise.all(relight.basis.map(async (block, term) => {
    const planes = await view.block(block);
    renderer.setTerm(term, new Uint16Array(planes));
    return at(floats(planes, "float16"), covered);
  }));
  if (given.includes("environment") && control.environment.value === "") tell("The environment of this address is not on this server. Choose another.");
  if (control.environment.value !== "") {
    const { name, data } = await load(control.environment.value);
    await useEnvironment(control.environment.value, name, data);
  }
  if (!given.includes("stops")) expose();
  change();
  canvas.dataset.ready = "";
  return {
    destroy: () => {
      cancelAnimationFrame(spinning);
      zoomed.destroy();
    },
    state,
    pixels: () => { draw(); return renderer.pixels(); },
    figures: () => renderer.timer.figures(),
    set: (direction) => move(direction),
    canvas,
    over: { ...zoomed.over, step: relight.step },
    turn,
  };
}

/** Return the places of at most `count` covered pixels, evenly spread. */
function spread(matte, count) {
  const inside = [];
  matte.forEach((cover, at) => { if (cover === 255) inside.push(at); });
  const step = Math.max(1, Math.floor(inside.length / count));
  return inside.filter((_, index) => index % step === 0);
}

/** Return the tile that a pixel lies in. */
function tileOf(place, { cols, tiles: { side, cols: across } }, index) {
  return index[Math.floor(Math.floor(place / cols) / side) * across + Math.floor((place % cols) / side)];
}

function sizeOf({ terms, rows, cols }) {
  return `${terms} coefficient images of ${((rows * cols) / 1e6).toPrecision(2)} megapixels`;
}

/** Return what a basis leaves, as measured when it was made. */
function errorOf({ held_out: held, relative_rms: captured }) {
  const levels = (value) => value.toPrecision(2);
  return `Against relit relight, under ${held.key_lights} lights that the basis was not made from: ${levels(held.mean_levels)} of 255 levels off on average, ${levels(held.largest_levels)} under the worst of them, ${levels(held.even_sky_levels)} under light from all around. It keeps the captured images within ${(100 * captured).toPrecision(2)} % (RMS). A view job with more terms is closer.`;
}

/** Return the colours [places, 3] of planes [3, pixels]. */
function at(planes, places) {
  const count = planes.length / 3;
  return places.flatMap((place) => [planes[place], planes[count + place], planes[2 * count + place]]);
}

function range(name, low, high, step, value) {
  return element("input", { type: "range", min: low, max: high, step, value, "aria-label": name });
}

function decoded(value) {
  return value <= 0.04045 ? value / 12.92 : ((value + 0.055) / 1.055) ** 2.4;
}

async function attemptHere(action) {
  try {
    await action();
  } catch (error) {
    tell(error.message);
  }
}
