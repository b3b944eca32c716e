/** Pointers, wheel and keys on the picture: one finger moves the light or the picture, two zoom. */

const STEP = 0.05;
const KEYS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };

/**
 * Listen on the picture.
 * @param {HTMLCanvasElement} canvas
 * @param {import("./view_state.js").ViewState} state
 * @param {{moves: function(): boolean, changed: function(object): void}} page Whether dragging moves the picture; what has changed.
 */
export function listen(canvas, state, { moves, changed }) {
  const down = new Map();
  const size = () => canvas.getBoundingClientRect();

  function lightAt({ clientX, clientY }) {
    const box = size();
    const half = Math.min(box.width, box.height) / 2;
    changed({ light: [(clientX - box.left - box.width / 2) / half, (box.top + box.height / 2 - clientY) / half] });
  }

  function shift(x, y) {
    const box = size();
    const scale = state.scale(box.width, box.height);
    changed({ centre: [state.centre[0] - x / scale, state.centre[1] - y / scale] });
  }

  /** Zoom about a point of the screen, which stays where it is. */
  function zoom(factor, x, y) {
    const box = size();
    const [fromX, fromY] = [x - box.left - box.width / 2, y - box.top - box.height / 2];
    const before = state.scale(box.width, box.height);
    changed({ zoom: state.zoom * factor });
    const after = state.scale(box.width, box.height);
    changed({ centre: [state.centre[0] + fromX / before - fromX / after, state.centre[1] + fromY / before - fromY / after] });
  }

  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    down.set(event.pointerId, event);
    if (down.size === 1 && !moves() && event.button === 0) lightAt(event);
  });
  canvas.addEventListener("pointermove", (event) => {
    const before = down.get(event.pointerId);
    if (before === undefined) return;
    down.set(event.pointerId, event);
    if (down.size === 2) {
      const other = [...down.values()].find((each) => each.pointerId !== event.pointerId);
      const apart = (each) => Math.hypot(each.clientX - other.clientX, each.clientY - other.clientY);
      shift((event.clientX - before.clientX) / 2, (event.clientY - before.clientY) / 2);
      if (apart(before) > 0) zoom(apart(event) / apart(before), (event.clientX + other.clientX) / 2, (event.clientY + other.clientY) / 2);
    } else if (moves() || event.buttons !== 1) shift(event.clientX - before.clientX, event.clientY - before.clientY);
    else lightAt(event);
  });
  for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, (event) => down.delete(event.pointerId));
  canvas.addEventListener("contextmenu", (event) => event.preventDefault()); // the right button moves the picture
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    zoom(2 ** (-event.deltaY / 300), event.clientX, event.clientY);
  }, { passive: false });
  canvas.addEventListener("keydown", (event) => {
    const box = size();
    const middle = [box.left + box.width / 2, box.top + box.height / 2];
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.key in KEYS) {
      const [x, y] = KEYS[event.key];
      if (event.shiftKey) shift(-40 * x, 40 * y);
      else changed({ light: [state.light[0] + STEP * x, state.light[1] + STEP * y] });
    } else if (event.key === "+" || event.key === "=") zoom(1.25, ...middle);
    else if (event.key === "-") zoom(0.8, ...middle);
    else if (event.key === "0") changed({ zoom: 1, centre: [state.width / 2, state.height / 2] });
    else return;
    event.preventDefault();
  });
  return { zoom: (factor) => zoom(factor, size().left + size().width / 2, size().top + size().height / 2) };
}
