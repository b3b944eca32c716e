/** Relights a capture live: a key light that is dragged, an environment that is spun, and captured lights to compare with. */

import { reveal } from "../../api.js";
import { breath, painted } from "../../breath.js";
import { element, tell } from "../../element.js";
import { ViewState } from "../../publish/view_state.js";
import { BasisRenderer, canRender } from "./basis_renderer.js";
import { converted, DISPLAY_SPACE, matrixBetween } from "../colour_spaces.js";
import { ControlAddress } from "../control_address.js";
import { mountDomeControl } from "./dome_control.js";
import { DrawLoop } from "./draw_loop.js";
import { previewOf, readEnvironment } from "./environment_map.js";
import { EnvironmentProfile } from "./environment_profile.js";
import { Exposure } from "./exposure.js";
import { LightModel } from "./light_model.js";
import { lightPanel, sizeOf } from "./light_panel.js";
import { viewTable } from "../view_transforms.js";
import { mountZoomed } from "../zoomed_picture.js";

const BEYOND_SHARE = 0.05; // from which the commands warn too
const SPIN_DEGREES_PER_S = 30;
const FIRST_LIGHT = [0.45, 0.5, 0.74]; // above right of the camera
const BACKDROP = 0.2; // encoded grey around the object, the same in light and dark, since colours are judged before it
const AROUND = `rgb(${Array(3).fill(Math.round(255 * BACKDROP))})`;
const SAME = 0.01; // of a direction
const REQUESTS = 4; // that the coefficient images come with
const LATE_MS = 1500; // from which it is said how many have come, and the rest of the page is shown
const NO_WEBGL = "This browser has no WebGL2, which live relighting needs. The frames can still be made by a job, and the captured images looked at.";

/**
 * Show the live relighting of a view.
 * @param {HTMLElement} parent Takes it.
 * @param {import("../view_file.js").ViewFile} view With `relight`.
 * @param {{environments: {id: string, name: string}[], load: function(string): Promise<{name: string, data: ArrayBuffer}>,
 *          onchange: function(any): void, embedded?: boolean}} options Environments of the server and how their files are read; `onchange` is told the
 *     light; `embedded`: the page moves the light, and the address is its own.
 * @returns {Promise<{destroy: function(): void, state: function(): any, pixels: function(): Uint8Array, set: function(any): void, settled: function(): Promise<void>,
 *     canvas: HTMLCanvasElement|null, over: object|null, turn: function(number): void}>} `over` is that of zoomed_picture.js; `turn` turns the environment by degrees,
 *     or the light where there is none; `settled` waits for the whole picture.
 */
export async function mount(parent, view, { environments, load, onchange, embedded = false }) {
  const { relight } = view.info;
  const lights = view.info.frames.filter((frame) => frame.direction !== null);
  const place = new ViewState({ width: relight.cols, height: relight.rows }, embedded ? {} : { light: 3, centre: 2, zoom: 1 }, FIRST_LIGHT);
  const drawn = element("canvas", { width: relight.cols, height: relight.rows });
  const front = element("canvas"); // the last picture that was done
  const warning = element("p", { class: "beyond", role: "status", hidden: true });
  const { control, panel, dome, preview, speed, play, expose: exposeButton, wipeRow } = lightPanel(relight, lights, environments);
  const stage = element("div", { class: "stage" });
  parent.replaceChildren(element("div", { class: "viewer" }, stage, panel));
  const pixelSize = view.info.camera.pixel_size_m ? view.info.camera.pixel_size_m * relight.step : null;
  const zoomed = mountZoomed(stage, front, place, { changed: onGesture, pixelSize, still: embedded });
  const { canvas } = zoomed;
  stage.append(warning);
  let loop = null; // until the picture can be drawn here
  let map = null; // { id, name, profile }
  let chosen = null; // stands for the environment that was chosen last, which may still come
  let asked = false;

  const address = embedded ? null : new ControlAddress({ on: control.lit, brightness: control.brightness, colour: control.colour, size: control.size,
    environment: control.environment, "environment-stops": control.environmentStops, turn: control.turn, stops: control.exposure, view: control.view,
    compare: control.compare, wipe: control.wipe });
  const given = address?.read() ?? [];
  const isFirst = !embedded && given.length === 0 && FIRST_LIGHT.every((part, axis) => Math.abs(part - place.light[axis]) < SAME);
  const card = isFirst ? view.card() : Promise.reject(); // a view that an earlier build has made has none

  const { quadrature } = relight;
  const tables = view.blocks([quadrature.inverse, quadrature.beyond, quadrature.outside, relight.captured, relight.tiles.index, relight.matte]);
  const each = Math.ceil(relight.terms / REQUESTS);
  const terms = relight.basis.flatMap((_, at) => (at % each === 0 ? view.blocks(relight.basis.slice(at, at + each)) : []));
  const coming = element("p", { class: "coming", role: "status" }, `0 of ${relight.terms} coefficient images are here.`);
  const late = setTimeout(() => { reveal(); stage.append(coming); }, LATE_MS);
  await card.then(showCard, () => {}); // before the graphics processor is waited for
  if (!canRender(drawn)) {
    parent.replaceChildren(element("p", { class: "fault" }, NO_WEBGL));
    return { destroy: () => {}, state: () => null, pixels: () => null, set: () => {}, settled: async () => {}, canvas: null, over: null, turn: () => {} };
  }
  const renderer = new BasisRenderer(drawn, relight, view.info.color_space); // its program is compiled while the blocks come
  const [inverse, beyond, outside, captured, index, coverage] = await Promise.all(tables);
  const model = new LightModel(relight, { inverse: new Float64Array(inverse), beyond: new Float32Array(beyond), outside: new Float32Array(outside), captured: new Uint16Array(captured) }, lights);
  const [tiles, matte] = [new Uint16Array(index), new Uint8Array(coverage)];
  renderer.setTiles(tiles);
  renderer.setMatte(matte);
  await breath();
  const exposure = new Exposure(relight, matte, tiles);
  const unitIrradiance = Math.max(...(lights[0]?.irradiance ?? [1]));
  const fromDisplay = matrixBetween(DISPLAY_SPACE, view.info.color_space);
  const domeControl = mountDomeControl(dome, model, lights.map((frame) => frame.direction), move);
  loop = new DrawLoop(renderer, show);

  /** Show the object as the server has lit it, until it is lit here. */
  async function showCard(picture) {
    [front.width, front.height] = [picture.width, picture.height];
    front.getContext("2d").drawImage(picture, 0, 0);
    canvas.dataset.shown = "card";
    zoomed.draw(AROUND);
    await painted();
  }

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
    if (loop === null) return;
    for (const each of Object.values(control)) each.dispatchEvent(new Event("set"));
    domeControl.set(control.lit.checked ? place.light : null);
    address?.write();
    wipeRow.hidden = control.compare.value === "";
    onchange(state());
    if (asked) return;
    asked = true;
    requestAnimationFrame(() => {
      asked = false;
      loop.ask(picture());
    });
  }

  /** Return what is to be drawn, as the renderer takes it, and warn of light from where none was captured. */
  function picture() {
    const now = state();
    const sum = sumOf(now);
    const chosen = control.compare.value;
    const share = model.shareBeyond(sum);
    warning.hidden = share < BEYOND_SHARE;
    canvas.classList.toggle("hatched", share >= BEYOND_SHARE);
    warning.textContent = warning.hidden ? "" : `${Math.round(100 * share)} % of the light comes from beyond the captured lights (more than ${relight.beyond_degrees.toFixed(0)}° from each): the nearest of them stand in for it, with their own shading and shadows.`;
    return { shown: model.coefficients(sum), compared: chosen === "" ? null : model.capturedImage(Number(chosen)), border: Number(control.wipe.value) / 100,
      gain: 2 ** now.exposure, backdrop: [BACKDROP, BACKDROP, BACKDROP] };
  }

  /** Show a picture that is done, of one of `stride` pixels in a row. */
  function show(stride) {
    const [width, height] = renderer.sizeOf(stride);
    if (front.width !== width || front.height !== height) [front.width, front.height] = [width, height];
    const context = front.getContext("2d");
    if (stride === 1) context.drawImage(drawn, 0, 0);
    else context.putImageData(new ImageData(renderer.pixels(stride), width), 0, 0); // the canvas as an image would be as large as the whole picture
    Object.assign(canvas.dataset, { stride, shown: "live" });
    zoomed.draw(AROUND);
    const { framesPerSecond, gpuMs } = renderer.timer.figures();
    const size = stride === 1 ? "" : `, at ${width} × ${height} pixels until it is still`;
    if (framesPerSecond !== null) speed.textContent = `${sizeOf(relight)}: ${framesPerSecond.toFixed(0)} pictures a second${gpuMs === null ? "" : `, ${gpuMs.toPrecision(2)} ms each on the graphics processor`}${size}.`;
  }

  function expose() {
    const stops = exposure.stops(model.coefficients(sumOf(state())));
    if (stops !== null) control.exposure.value = String(stops);
  }

  function sumOf(now) {
    const key = now.light === null ? null : { ...now.light, irradiance: converted(fromDisplay, now.light.irradiance) };
    return model.sum(key, map === null ? null : model.turned(map.profile, now.environment.turn_degrees, 2 ** now.environment.exposure));
  }

  /** Use an environment, and return whether it is still the one that is wanted when it has been read. */
  async function useEnvironment(id, name, data, isWanted = () => true) {
    const found = await readEnvironment(data, name, view.info.color_space);
    if (!isWanted()) return false;
    map = { id, name, profile: new EnvironmentProfile(found, model.rows) };
    preview.replaceChildren(previewOf(found));
    change();
    return true;
  }

  /** Show an environment alone at first, exposed for it; the key light comes back when it is moved or switched on. */
  async function chooseEnvironment(id, file) {
    const mine = {};
    chosen = mine;
    const { name, data } = await file();
    const isFirst = map === null;
    if (!(await useEnvironment(id, name, data, () => chosen === mine))) return; // another was chosen while it was loaded
    if (isFirst) control.lit.checked = false;
    expose();
    change();
  }

  function dropEnvironment() {
    chosen = null;
    control.lit.checked = true;
    map = null;
    preview.replaceChildren();
    change();
  }

  function turn(degrees) {
    if (map !== null) {
      control.turn.value = String((Number(control.turn.value) + degrees + 360) % 360);
      change();
      return;
    }
    move(turnedAside(place.light, degrees));
  }

  drawn.addEventListener("webglcontextlost", () => tell("The graphics processor has stopped drawing.", "fault", () => location.reload()));
  for (const each of [control.lit, control.brightness, control.colour, control.size, control.environmentStops, control.turn, control.exposure, control.wipe, control.compare]) {
    each.addEventListener("input", change);
  }
  exposeButton.addEventListener("click", () => { expose(); change(); });
  control.view.addEventListener("change", () => attemptHere(useView));
  control.environment.addEventListener("change", () => attemptHere(async () => {
    const id = control.environment.value;
    if (id === "") dropEnvironment();
    else await chooseEnvironment(id, () => load(id));
  }));
  control.file.addEventListener("change", () => attemptHere(async () => {
    const [file] = control.file.files;
    if (file === undefined) return;
    control.environment.value = "";
    await chooseEnvironment(null, async () => ({ name: file.name, data: await file.arrayBuffer() }));
  }));

  async function useView() {
    const wanted = control.view.value;
    const table = await viewTable(wanted);
    if (control.view.value !== wanted) return; // another was chosen meanwhile
    renderer.setView(table);
    change();
  }

  /** Return when the whole picture is shown of what was last asked for. */
  async function settled() {
    await new Promise((resolve) => { requestAnimationFrame(resolve); });
    await loop.settled();
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

  for (const [term, block] of terms.entries()) {
    const planes = new Uint16Array(await block);
    await renderer.setTerm(term, planes);
    exposure.setTerm(term, planes);
    coming.textContent = `${term + 1} of ${relight.terms} coefficient images are here.`;
  }
  clearTimeout(late);
  coming.remove();
  if (given.includes("environment") && control.environment.value === "") tell("The environment of this address is not on this server. Choose another.");
  if (control.environment.value !== "") {
    const { value } = control.environment;
    const isWanted = () => chosen === null && control.environment.value === value; // else another was chosen meanwhile
    const { name, data } = await load(value);
    await useEnvironment(value, name, data, isWanted);
  }
  if (given.includes("view")) await attemptHere(useView);
  if (!given.includes("stops")) expose();
  change();
  await settled();
  canvas.dataset.ready = "";
  return {
    destroy: () => {
      cancelAnimationFrame(spinning);
      loop.stop();
      zoomed.destroy();
    },
    state,
    pixels: () => { loop.drawNow(picture()); return renderer.pixels(); },
    settled,
    figures: () => renderer.timer.figures(),
    set: (direction) => move(direction),
    canvas,
    over: { ...zoomed.over, step: relight.step },
    turn,
  };
}

/** Return a direction turned around the view axis, so that a light stays among the captured ones. */
export function turnedAside([x, y, z], degrees) {
  const [cos, sin] = [Math.cos((degrees * Math.PI) / 180), Math.sin((degrees * Math.PI) / 180)];
  return [x * cos - y * sin, x * sin + y * cos, z];
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
