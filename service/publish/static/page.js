/** Lights published planes live. */

import { listen } from "./gestures.js";
import { Basis } from "./basis.js";
import { mountNotes, showScale } from "./overlay.js";
import { PlaneRenderer } from "./plane_renderer.js";
import { Tiles } from "./tiles.js";
import { ViewState } from "./view_state.js";

const byId = (id) => document.getElementById(id);
const canvas = byId("picture");
document.documentElement.classList.toggle("embedded", new URLSearchParams(location.search).has("embed"));

async function json(name) {
  const response = await fetch(name);
  if (!response.ok) throw new Error(`${name} cannot be read (${response.status}).`);
  return response.json();
}

async function start() {
  const [info, scene] = await Promise.all([json("info.json"), json("scene.json")]);
  const terms = info.nplanes / 3;
  const basis = new Basis(info);
  const state = new ViewState(info);
  const renderer = new PlaneRenderer(canvas, terms);
  const tiles = new Tiles(info, renderer, draw, (error) => { byId("state").textContent = error.message; });
  let asked = false;
  let moves = false;
  const putNotes = mountNotes(byId("notes"), byId("texts"), scene.notes, (note) => {
    const zoom = note.width > 0 ? Math.max(1, 0.5 * Math.min(info.width / note.width, info.height / note.height)) : Math.max(state.zoom, 3);
    changed({ centre: [note.x + note.width / 2, note.y + note.height / 2], zoom });
  });
  for (let at = 0; at < info.lights.length; at += 3) {
    const dot = document.createElementNS("http://www.w3.org/2000/svg", "circle");
    for (const [name, value] of [["cx", info.lights[at]], ["cy", -info.lights[at + 1]], ["r", 0.02]]) dot.setAttribute(name, value);
    byId("captured").append(dot);
  }

  function changed(changes) {
    state.set(changes);
    draw();
  }

  function draw() {
    if (asked) return;
    asked = true;
    requestAnimationFrame(() => {
      asked = false;
      paint();
    });
  }

  /** Write the code for another page that shows what is shown now. */
  function embed() {
    const title = scene.title.replaceAll("&", "&amp;").replaceAll("\"", "&quot;");
    const code = `<iframe src="${location.origin}${location.pathname}?embed#${state.text()}" title="${title}" width="800" height="600" allowfullscreen></iframe>`;
    byId("embed").querySelector("textarea").value = code;
  }

  function paint() {
    const { width, height } = canvas.getBoundingClientRect();
    const ratio = globalThis.devicePixelRatio;
    const size = [Math.max(1, Math.round(width * ratio)), Math.max(1, Math.round(height * ratio))];
    if (canvas.width !== size[0] || canvas.height !== size[1]) [canvas.width, canvas.height] = size;
    const scale = state.scale(width, height);
    const [x, y] = state.centre;
    const placeOf = (u, v) => [width / 2 + (u - x) * scale, height / 2 + (v - y) * scale];
    const part = { left: x - width / 2 / scale, right: x + width / 2 / scale, top: y - height / 2 / scale, bottom: y + height / 2 / scale };
    const { whole, shown } = tiles.covering(part, scale * ratio);
    const { factor, constant } = basis.sums(state.direction(), 2 ** (state.stops / 2.2));
    renderer.draw(shown.map(({ texture, box }) => {
      const [[left, top], [right, bottom]] = [placeOf(box[0], box[1]), placeOf(box[2], box[3])];
      return { texture, box: [2 * left / width - 1, 1 - 2 * top / height, 2 * right / width - 1, 1 - 2 * bottom / height] };
    }), factor, constant);
    if (shown.length > 0) {
      if (whole) byId("state").textContent = "";
      canvas.dataset.ready = whole ? "whole" : "coarse";
    }
    putNotes(placeOf);
    if (byId("embed").open) embed();
    if (info.pixelSizeInMM !== undefined) showScale(byId("scale"), info.pixelSizeInMM / scale);
    byId("lamp").setAttribute("cx", state.light[0]);
    byId("lamp").setAttribute("cy", -state.light[1]);
    [byId("light-x").value, byId("light-y").value, byId("stops").value] = [...state.light, state.stops];
  }

  const { zoom } = listen(canvas, state, { moves: () => moves, changed });
  const dragging = (now) => {
    moves = now;
    canvas.classList.toggle("moves", moves);
    byId("mode-light").setAttribute("aria-pressed", String(!moves));
    byId("mode-move").setAttribute("aria-pressed", String(moves));
  };
  const sliders = () => changed({ light: [Number(byId("light-x").value), Number(byId("light-y").value)], stops: Number(byId("stops").value) });
  for (const name of ["light-x", "light-y", "stops"]) byId(name).addEventListener("input", sliders);
  const buttons = {
    "mode-light": () => dragging(false), "mode-move": () => dragging(true), closer: () => zoom(1.5), farther: () => zoom(1 / 1.5),
    whole: () => changed({ zoom: 1, centre: [info.width / 2, info.height / 2] }),
    full: () => (document.fullscreenElement === null ? byId("stage").requestFullscreen() : document.exitFullscreen()),
  };
  for (const [name, action] of Object.entries(buttons)) byId(name).addEventListener("click", action);
  byId("embed").addEventListener("toggle", embed);
  addEventListener("hashchange", () => {
    state.read();
    draw();
  });
  new ResizeObserver(draw).observe(canvas);
  canvas.addEventListener("webglcontextlost", () => location.reload());
}

start().catch((error) => {
  byId("state").textContent = location.protocol === "file:" ? "Open this page through a web server: browsers read no files beside a page that is a file itself." : error.message;
});
