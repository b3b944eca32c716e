/** A diagram of all directions around the object, seen from the camera, on which a light is moved. Light from beyond the captured is hatched. */

import { placeOf } from "../../dome.js";
import { element } from "../../element.js";
import { unit } from "./disc_light.js";

const SIDE = 240;
const STEP_DEGREES = 5;
const [HATCH, GROUND] = [[200, 70, 50, 255], [128, 122, 118, 60]];
const BACK = 2; // radius of the direction −z, where 1 is 90° from the view axis

/** Return the direction at a place of the diagram, the inverse of placeOf; places outside are moved to its rim. */
function directionAt(x, y) {
  const radius = Math.min(Math.hypot(x, y), BACK - 1e-3);
  const angle = (radius * Math.PI) / 2;
  const across = Math.hypot(x, y) || 1;
  return [(Math.sin(angle) * x) / across, (-Math.sin(angle) * y) / across, Math.cos(angle)];
}

/**
 * Show the diagram.
 * @param {HTMLElement} parent Takes it.
 * @param {{isBeyond: function(number[]): boolean}} model
 * @param {number[][]} captured Directions of the captured lights.
 * @param {function(number[]): void} moved Called with another direction of the light.
 * @returns {{set: function(number[]|null): void}} Shows the light; null: there is none.
 */
export function mountDomeControl(parent, model, captured, moved) {
  const canvas = element("canvas", { width: SIDE, height: SIDE, class: "dome", tabindex: 0, role: "application",
    "aria-label": "Direction of the light. Arrow keys move it by five degrees." });
  const words = element("output", { "aria-live": "polite" });
  parent.replaceChildren(canvas, words, element("p", { class: "help" },
    "Middle: towards the camera; inner circle: 90° from it; rim: behind the object. Hatched: beyond the captured lights."));
  const context = canvas.getContext("2d");
  const toCanvas = ([x, y]) => [(SIDE / 2) * (1 + x / BACK), (SIDE / 2) * (1 + y / BACK)];
  const ground = drawGround();
  let light = null;

  function drawGround() {
    const image = new ImageData(SIDE, SIDE);
    for (let row = 0; row < SIDE; row += 1) {
      for (let col = 0; col < SIDE; col += 1) {
        const [x, y] = [((2 * col + 1) / SIDE - 1) * BACK, ((2 * row + 1) / SIDE - 1) * BACK];
        if (Math.hypot(x, y) > BACK) continue;
        const hatched = model.isBeyond(directionAt(x, y));
        image.data.set(hatched && (row + col) % 8 < 3 ? HATCH : GROUND, 4 * (row * SIDE + col));
      }
    }
    return image;
  }

  function draw() {
    context.putImageData(ground, 0, 0);
    const ink = getComputedStyle(canvas).color;
    context.strokeStyle = ink;
    context.lineWidth = 1;
    for (const radius of [1, BACK]) {
      context.beginPath();
      context.arc(SIDE / 2, SIDE / 2, (radius * (SIDE / 2 - 1)) / BACK, 0, 2 * Math.PI);
      context.stroke();
    }
    context.fillStyle = ink;
    for (const direction of captured) dot(direction, 1.7);
    if (light !== null) {
      context.fillStyle = "#ffb347";
      dot(light, 7);
      context.stroke();
    }
  }

  function dot(direction, radius) {
    context.beginPath();
    context.arc(...toCanvas(placeOf(direction)), radius, 0, 2 * Math.PI);
    context.fill();
  }

  function set(direction) {
    light = direction;
    draw();
    if (direction === null) words.textContent = "";
    else {
      const [x, y, z] = direction;
      const degrees = (radians) => Math.round((180 * radians) / Math.PI);
      const side = (angle, more, less) => `${Math.abs(angle)}° ${angle < 0 ? less : more}`;
      words.textContent = `${degrees(Math.acos(Math.max(-1, Math.min(1, z))))}° from the camera, ${side(degrees(Math.asin(y)), "up", "down")}, ${side(degrees(Math.atan2(x, z)), "to the right", "to the left")}${model.isBeyond(direction) ? ": beyond the captured lights" : ""}`;
    }
  }

  function drag(event) {
    const box = canvas.getBoundingClientRect();
    moved(directionAt(((2 * (event.clientX - box.left)) / box.width - 1) * BACK, ((2 * (event.clientY - box.top)) / box.height - 1) * BACK));
  }

  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    drag(event);
  });
  canvas.addEventListener("pointermove", (event) => event.buttons !== 0 && drag(event));
  canvas.addEventListener("keydown", (event) => {
    const turn = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
    if (turn === undefined) return;
    event.preventDefault();
    const [x, y] = placeOf(light ?? [0, 0, 1]);
    moved(unit(directionAt(x + (turn[0] * STEP_DEGREES) / 90, y + (turn[1] * STEP_DEGREES) / 90)));
  });
  draw();
  return { set };
}
