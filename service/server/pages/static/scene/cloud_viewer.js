/** Shows the points of a depth in 3D, coloured by depth, confidence or photograph. */

import { BufferAttribute, BufferGeometry, LinearSRGBColorSpace, Points, PointsMaterial, Vector3 } from "three";
import { element, numberOf, tell } from "../element.js";
import { canRender } from "../view/light/basis_renderer.js";
import { COLOUR_MAPS, colourTable } from "../view/display.js";
import { mountHistogram, short } from "../view/maps/histogram.js";
import { OrbitScene } from "./orbit_scene.js";

const NO_WEBGL = "This browser has no WebGL2, which the points need. The maps above show the same depth, and the job's points.ply holds the points.";
const PHOTOGRAPH = "photograph";
const PICK_PX = 8; // how near a click must be to a point
const MOST_SIZE = 8;

/**
 * Show the points of a view.
 * @param {HTMLElement} parent Takes them.
 * @param {import("../view/view_file.js").ViewFile} view With `points`.
 * @returns {Promise<{destroy: function(): void, state: function(): any, picture: function(): {rows: number, cols: number, pixels: Uint8Array}}>}
 */
export async function mount(parent, view) {
  const { points } = view.info;
  if (!canRender()) {
    parent.replaceChildren(element("p", { class: "fault" }, NO_WEBGL));
    return { destroy: () => {}, state: () => null, picture: () => null };
  }
  const [positions, depth, confidence, photograph] = await Promise.all([points.positions, points.depth, points.confidence, points.colours]
    .map((block) => (block === null ? null : view.block(block))));
  const values = { depth: new Float32Array(depth), confidence: Float32Array.from(new Uint8Array(confidence), (byte) => byte / 255) };
  const unit = view.layer("depth")?.unit ?? "m";
  const units = { depth: ` ${unit}`, confidence: "" };
  const total = points.count + points.unsure;

  const stage = element("div", { class: "stage" });
  const value = element("output", { class: "value", "aria-live": "polite" }, "Click a point, or press Enter for the one in the middle, to read its values.");
  const histogram = element("div", { class: "histogram" });
  const control = {
    by: element("select", {}, element("option", { value: "depth" }, "Depth"), element("option", { value: "confidence" }, "Confidence"),
      points.colours === null ? null : element("option", { value: PHOTOGRAPH }, "Photograph")),
    map: element("select", {}, ...COLOUR_MAPS.map((name) => element("option", { value: name }, name))),
    size: element("input", { type: "range", min: 1, max: MOST_SIZE, step: 0.5, value: 2 }),
    unsure: element("input", { type: "checkbox", checked: true }),
  };
  const row = (text, each) => element("label", {}, `${text} `, each, each.type === "range" ? numberOf(each) : null);
  const mapRow = row("Colour map", control.map);
  const counts = `${points.count.toLocaleString()} points${points.unsure === 0 ? ", none of them unsure" : `, and ${points.unsure.toLocaleString()} that are unsure`}.`;
  const every = points.step === 1 ? "" : ` One of ${points.step} × ${points.step} pixels is shown.`;
  const panel = element("div", { class: "panel" }, row("Colour by", control.by), mapRow, histogram, row("Size of a point", control.size),
    points.unsure === 0 ? null : row("Show unsure points", control.unsure),
    element("p", { class: "actions" }, element("button", { type: "button", class: "quiet", onclick: () => orbit.reset() }, "As it was captured")),
    element("p", { class: "help" }, counts + every));
  parent.replaceChildren(element("div", { class: "viewer" }, stage, panel));

  const colours = new BufferAttribute(new Uint8Array(3 * total), 3, true);
  const geometry = new BufferGeometry();
  geometry.setAttribute("position", new BufferAttribute(new Float32Array(positions), 3));
  geometry.setAttribute("color", colours);
  const material = new PointsMaterial({ vertexColors: true, sizeAttenuation: false, toneMapped: false });
  const cloud = new Points(geometry, material);
  const orbit = new OrbitScene(stage, "The points of the depth in 3D", { onclick: pick, onfault: (sentence) => { if (sentence !== "") tell(sentence); } });
  orbit.renderer.outputColorSpace = LinearSRGBColorSpace; // colours are bytes for the screen already
  orbit.scene.add(cloud);
  orbit.frame(cloud);
  stage.append(value);
  const ranges = Object.fromEntries(Object.keys(values).map((name) => [name, view.layer(name)?.range ?? extremes(values[name])]));

  /** Colour all points anew. */
  function paint() {
    const by = control.by.value;
    if (by === PHOTOGRAPH) {
      colours.array.set(new Uint8Array(photograph));
    } else {
      const [low, high] = ranges[by];
      const table = colourTable(control.map.value);
      const scale = 255 / (high - low || 1);
      for (let at = 0; at < total; at += 1) {
        const step = 3 * Math.max(0, Math.min(255, Math.round((values[by][at] - low) * scale)));
        colours.array[3 * at] = table[step];
        colours.array[3 * at + 1] = table[step + 1];
        colours.array[3 * at + 2] = table[step + 2];
      }
    }
    colours.needsUpdate = true;
    orbit.changed();
  }

  function select() {
    const by = control.by.value;
    const layer = view.layer(by);
    mapRow.hidden = by === PHOTOGRAPH;
    histogram.replaceChildren();
    if (layer !== undefined) {
      const [low, high] = ranges[by];
      mountHistogram(histogram, layer, view.info.codes, { low, high }, (range) => {
        ranges[by] = [range.low, range.high];
        paint();
      });
    }
    paint();
  }

  function change() {
    material.size = Number(control.size.value);
    geometry.setDrawRange(0, shown()); // the unsure points come last
    orbit.changed();
  }

  function shown() {
    return control.unsure.checked ? total : points.count;
  }

  /** Read the point that is nearest to the viewer among those around a place of the picture. */
  function pick(place) {
    const { canvas, camera } = orbit;
    camera.updateMatrixWorld();
    const projected = new Vector3();
    let found = null;
    for (let at = 0; at < shown(); at += 1) {
      projected.fromBufferAttribute(geometry.getAttribute("position"), at).project(camera);
      const off = Math.hypot((projected.x - place.x) * canvas.clientWidth, (projected.y - place.y) * canvas.clientHeight) / 2;
      if (off <= PICK_PX && Math.abs(projected.z) <= 1 && (found === null || projected.z < found.z)) found = { at, z: projected.z };
    }
    if (found === null) {
      value.textContent = "There is no point here.";
      return;
    }
    const [x, y, z] = [0, 1, 2].map((axis) => short(geometry.getAttribute("position").array[3 * found.at + axis]));
    const read = Object.entries(values).map(([name, each]) => `${name} ${short(each[found.at])}${units[name]}`).join(", ");
    value.textContent = `x ${x}, y ${y}, z ${z} ${unit} in the camera frame; ${read}${found.at < points.count ? "" : "; unsure: the value is not vouched for"}.`;
  }

  control.by.addEventListener("change", select);
  control.map.addEventListener("change", select);
  for (const each of [control.size, control.unsure]) each.addEventListener("input", change);
  change();
  select();

  return {
    destroy() {
      orbit.destroy();
      parent.replaceChildren();
    },
    state: () => ({ by: control.by.value, shown: shown(), range: ranges[control.by.value] ?? null }),
    picture: () => orbit.picture(),
  };
}

function extremes(values) {
  let [low, high] = [Infinity, -Infinity];
  for (const each of values) {
    low = Math.min(low, each);
    high = Math.max(high, each);
  }
  return [low, high];
}
