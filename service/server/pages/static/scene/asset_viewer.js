/** Shows an asset as programs that open it do: in 3D, lit by a room, an environment map or one light of the rig, with the rig's lights around it. */

import { Group, LinearToneMapping, Matrix4 } from "three";
import { element, numberOf, tell } from "../element.js";
import { openAsset } from "./asset_file.js";
import { facingIrradiance, Lighting, neutralRoom, stopsFor } from "./asset_lighting.js";
import { converted, DISPLAY_SPACE, matrixBetween } from "../view/colour_spaces.js";
import { VIEW_TRANSFORM } from "../view/display.js";
import { previewOf, readEnvironment } from "../view/light/environment_map.js";
import { Address } from "../publish/address.js";
import { ControlAddress } from "../view/control_address.js";
import { Distance, lengthText } from "./distance.js";
import { OrbitScene } from "./orbit_scene.js";
import { showPoster } from "./poster.js";
import { RigLights } from "./rig_lights.js";
import { SURFACES, Surfaces } from "./surfaces.js";

const ROOM = "room";
const MAP = "map";
const MOST_STOPS = 10;

/**
 * Show an asset.
 * @param {HTMLElement} parent Takes it.
 * @param {{name: string, data: ArrayBuffer}} file The asset, .usdz or .glb.
 * @param {{rig?: any, environments?: {id: string, name: string}[], load?: function(string): Promise<{name: string, data: ArrayBuffer}>, poster?: ImageBitmap|null}} [options]
 *     `rig` is the content of view.json of the capture, null if it is not known: then no lights are shown. Environments of the server, and how their files are read.
 *     `poster` stands there until the asset is drawn.
 * @returns {Promise<{destroy: function(): void, state: function(): any, picture: function(): {rows: number, cols: number, pixels: Uint8Array}}>}
 * @throws {Error} The asset cannot be opened; a sentence.
 */
export async function mount(parent, file, { rig = null, environments = [], load = undefined, poster = null } = {}) {
  const asset = await openAsset(file.data, file.name);
  const lights = (rig?.frames ?? []).map((frame, index) => ({ frame, index })).filter(({ frame }) => frame.kind === "light" && frame.direction !== null);
  const stage = element("div", { class: "stage" });
  const fault = element("p", { class: "fault", role: "status" });
  const preview = element("div");
  const control = {
    lit: element("select", {}, element("option", { value: ROOM }, "A neutral room"), element("option", { value: MAP, disabled: true }, "An environment map"),
      ...lights.map(({ frame, index }) => element("option", { value: index }, `${frame.image}: ${frame.label}`))),
    environment: element("select", {}, element("option", { value: "" }, "none"), ...environments.map(({ id, name }) => element("option", { value: id }, name))),
    file: element("input", { type: "file", accept: ".exr,.hdr", class: "visually-hidden" }),
    turn: element("input", { type: "range", min: 0, max: 360, step: 1, value: 0 }),
    exposure: element("input", { type: "range", min: -MOST_STOPS, max: MOST_STOPS, step: 0.1, value: 0 }),
    markers: element("input", { type: "checkbox", checked: true }),
    shadows: element("input", { type: "checkbox", checked: true }),
    surface: element("select", {}, ...Object.entries(SURFACES).map(([value, text]) => element("option", { value }, text))),
  };
  const row = (text, each) => element("label", {}, `${text} `, each, each.type === "range" ? numberOf(each) : null);
  const turnRow = row("Turn (degrees)", control.turn);
  const shadowsRow = row("Shadows", control.shadows);
  const measured = element("output", { "aria-live": "polite" });
  const measure = element("button", { type: "button", class: "quiet", "aria-pressed": "false", onclick: () => {
    measures = !measures;
    measure.setAttribute("aria-pressed", String(measures));
    distance.clear();
    measured.textContent = measures ? "Choose two points of the object, by a click or by Enter for the middle." : "";
    view.changed();
  } }, "Measure a distance");
  let measures = false;
  const panel = element("div", { class: "panel" },
    row("Lit by", control.lit), shadowsRow, row("Surface", control.surface),
    element("fieldset", {}, element("legend", {}, "Environment"), environments.length > 0 ? row("Map", control.environment) : null,
      element("label", { class: "button quiet" }, "Open a file", control.file), preview, turnRow),
    row("Exposure (stops)", control.exposure),
    lights.length > 0 ? row("Lights of the rig", control.markers) : null,
    element("p", { class: "actions" }, element("button", { type: "button", class: "quiet", onclick: () => view.reset() }, "As it was captured"), measure), measured,
    element("p", { class: "help" }, words(asset, lights)),
    ...asset.problems.map((problem) => element("p", { class: "fault" }, problem)));
  parent.replaceChildren(element("div", { class: "viewer" }, stage, panel));
  stage.append(fault);

  const room = neutralRoom();
  let map = null; // { name, ...pixels }
  let chosen = null; // stands for the map that was chosen last, which may still come
  const view = new OrbitScene(stage, `The asset ${file.name} in 3D`, { onclick: pick, onfault: (sentence) => { fault.textContent = sentence; } });
  if (poster !== null) showPoster(view.canvas, poster);
  const { scene, renderer } = view;
  renderer.toneMapping = LinearToneMapping;
  const inCameraFrame = new Group(); // as all of Relit's pictures are, wherever the capture says that the camera stood
  if (rig?.camera.world_from_camera) inCameraFrame.applyMatrix4(new Matrix4().set(...rig.camera.world_from_camera.flat()).invert());
  inCameraFrame.add(asset.object);
  scene.add(inCameraFrame);
  view.frame(inCameraFrame);
  const lighting = new Lighting(scene, renderer, view.center, view.radius);
  const surfaces = new Surfaces(asset.object);
  const distance = new Distance(inCameraFrame, colourOf(parent, "--accent"));
  scene.add(distance.shown);
  const markers = new RigLights(lights, view.center, view.radius, { light: colourOf(parent, "--accent"), suspect: colourOf(parent, "--warn") });
  scene.add(markers.object);

  /** Light the asset as chosen, and expose for it. */
  function light() {
    const chosen = control.lit.value;
    let irradiance;
    if (chosen === ROOM || chosen === MAP) {
      const shown = chosen === ROOM ? room : map;
      lighting.byMap(shown);
      irradiance = facingIrradiance(shown);
    } else {
      const { frame } = lights.find(({ index }) => index === Number(chosen));
      const shown = frame.irradiance === null ? [1, 1, 1] : converted(matrixBetween(rig.color_space, DISPLAY_SPACE), frame.irradiance);
      lighting.byLight(frame.direction, shown, control.shadows.checked);
      irradiance = Math.max(...shown);
    }
    markers.choose(chosen === ROOM || chosen === MAP ? null : Number(chosen));
    turnRow.hidden = chosen !== MAP;
    shadowsRow.hidden = chosen === ROOM || chosen === MAP;
    control.exposure.value = String(Math.max(-MOST_STOPS, Math.min(MOST_STOPS, stopsFor(irradiance))));
    change();
  }

  function change() {
    lighting.turn(control.lit.value === MAP ? Number(control.turn.value) : 0);
    renderer.toneMappingExposure = 2 ** Number(control.exposure.value);
    for (const each of [control.turn, control.exposure]) each.dispatchEvent(new Event("set"));
    markers.object.visible = control.markers.checked;
    view.changed();
  }

  function pick(place) {
    if (measures) {
      const count = distance.take(place, view.camera);
      if (count !== null) measured.textContent = count === 1 ? "Choose the other point." : `${lengthText(distance.value)}${hasScale(rig) ? "" : ". The capture does not say its scale: this is true of a measured depth alone."}`;
      view.changed();
      return;
    }
    const index = markers.at(place, view.camera, inCameraFrame);
    if (index === null) return;
    control.lit.value = String(index);
    light();
  }

  async function use(read) {
    const mine = {};
    chosen = mine;
    let found;
    try {
      const { name, data } = await read();
      found = { name, ...(await readEnvironment(data, name, DISPLAY_SPACE)) };
    } catch (error) {
      tell(error.message);
      return;
    }
    if (chosen !== mine) return; // another was chosen meanwhile
    map = found;
    preview.replaceChildren(previewOf(map));
    control.lit.options[1].disabled = false;
    control.lit.options[1].textContent = `The environment map ${map.name}`;
    control.lit.value = MAP;
    light();
  }

  renderer.domElement.addEventListener("webglcontextrestored", () => { lighting.forgetMaps(); light(); });
  control.lit.addEventListener("change", light);
  control.shadows.addEventListener("change", light);
  control.surface.addEventListener("change", () => { surfaces.show(control.surface.value); view.changed(); });
  for (const each of [control.turn, control.exposure, control.markers]) each.addEventListener("input", change);
  control.environment.addEventListener("change", () => {
    const id = control.environment.value;
    if (id !== "") return use(() => load(id));
    chosen = null;
    if (control.lit.value === MAP) control.lit.value = ROOM;
    return light();
  });
  control.file.addEventListener("change", () => {
    const [given] = control.file.files;
    control.environment.value = "";
    if (given !== undefined) use(async () => ({ name: given.name, data: await given.arrayBuffer() }));
  });
  for (const option of [...control.surface.options]) if (!surfaces.has(option.value)) option.remove();
  const [address, camera] = [new ControlAddress({ "lit-by": control.lit, surface: control.surface, markers: control.markers, shadows: control.shadows }), new Address({ camera: 6 })];
  address.read();
  if (control.lit.value === MAP) control.lit.value = ROOM; // of a file that is not open yet
  const given = {};
  camera.read(given);
  if (given.camera !== undefined) view.place = given.camera;
  view.onmove(() => camera.write({ camera: view.place }));
  panel.addEventListener("change", () => address.write());
  surfaces.show(control.surface.value);
  light();

  return {
    destroy() {
      surfaces.destroy();
      lighting.destroy();
      view.destroy();
      parent.replaceChildren();
    },
    state: () => ({ lit: control.lit.value, environment: map?.name ?? null, turn_degrees: Number(control.turn.value), exposure: Number(control.exposure.value),
      triangles: asset.triangles, points: asset.points, textures: asset.textures, problems: asset.problems, distance: distance.value }),
    picture: () => view.picture(),
    settled: () => view.settled(),
  };
}

/** Return a colour of the page as three.js reads it, in light or dark as the page is. */
function colourOf(parent, token) {
  const probe = element("span", { hidden: true });
  probe.style.color = `var(${token})`;
  parent.append(probe);
  const { color } = getComputedStyle(probe);
  probe.remove();
  return color;
}

/** Return whether lengths of an asset are known in metres. */
function hasScale(rig) {
  return rig !== null && Boolean(rig.camera.projection === "orthographic" ? rig.camera.pixel_size_m : rig.camera.surface_z_m);
}

function words({ triangles, points, textures }, lights) {
  const count = (number, name) => `${number.toLocaleString()} ${name}${number === 1 ? "" : "s"}`;
  const has = points > 0 ? count(points, "point") : `${count(triangles, "triangle")}, ${count(textures, "texture")}`;
  const near = lights.filter(({ frame }) => frame.near).length;
  const around = lights.length === 0 ? "" : ` Around it are the ${count(lights.length, "light")} of the rig${near === 0 ? "" : `, ${near} of them near: they are shown by their direction`}; choose one to see the asset under it.`;
  return `${has}.${around} Shown by three.js, with shadows of a chosen light alone, through ${VIEW_TRANSFORM}. White is a white surface that faces the light.`;
}
