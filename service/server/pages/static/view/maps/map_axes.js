/** Rows and columns of a map along the edges of its canvas. */

const APART_PX = 70; // CSS pixels between two numbers, at least
const TICK_PX = 5;
const FONT_PX = 11;

/** Return the numbers of an axis, a step of 1, 2 or 5 times a power of ten apart, at least so far that `shortest` pixels lie between two. */
export function ticks(first, last, shortest) {
  const power = 10 ** Math.floor(Math.log10(Math.max(shortest, 1)));
  const step = [1, 2, 5, 10].map((each) => each * power).find((each) => each >= shortest);
  const found = [];
  for (let at = Math.ceil(first / step) * step; at <= last; at += step) found.push(at);
  return found;
}

/**
 * Draw the numbers of columns below and of rows to the left.
 * @param {CanvasRenderingContext2D} context
 * @param {{x: number, y: number, scale: number}} place Left, top and canvas pixels per pixel of the map.
 * @param {{rows: number, cols: number}} size
 * @param {{left: number, right: number}} part Columns of the canvas in which the map is.
 * @param {{ink: string, paper: string}} colours
 */
export function drawAxes(context, place, { rows, cols }, { left, right }, { ink, paper }) {
  const ratio = globalThis.devicePixelRatio ?? 1;
  const { height } = context.canvas;
  const shortest = (APART_PX * ratio) / place.scale;
  const within = (value, most) => Math.min(Math.max(value, 0), most - 1);
  context.save();
  context.font = `${FONT_PX * ratio}px sans-serif`;
  const write = (text, x, y, align) => {
    context.textAlign = align;
    context.textBaseline = align === "center" ? "bottom" : "middle";
    context.strokeStyle = paper;
    context.lineWidth = 3 * ratio;
    context.strokeText(text, x, y);
    context.fillStyle = ink;
    context.fillText(text, x, y);
  };
  for (const col of ticks(within((left - place.x) / place.scale, cols), within((right - place.x) / place.scale, cols), shortest)) {
    const x = place.x + (col + 0.5) * place.scale;
    context.fillStyle = ink;
    context.fillRect(x, height - TICK_PX * ratio, ratio, TICK_PX * ratio);
    write(String(col), x, height - TICK_PX * ratio, "center");
  }
  for (const row of ticks(within(-place.y / place.scale, rows), within((height - place.y) / place.scale, rows), shortest)) {
    const y = place.y + (row + 0.5) * place.scale;
    if (y < FONT_PX * ratio / 2 || y > height - 2 * FONT_PX * ratio) continue; // above it would be cut, below are the columns
    context.fillStyle = ink;
    context.fillRect(left, y, TICK_PX * ratio, ratio);
    write(String(row), left + (TICK_PX + 2) * ratio, y, "left");
  }
  context.restore();
}
