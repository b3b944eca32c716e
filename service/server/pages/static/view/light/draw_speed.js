/** How long drawings take: a part that each takes whatever its size, as what the browser does with it, and a part for each pixel. */

const FIRST_MS_PER_PIXEL = 1 / 2000; // of a slow program on one core; the first drawings tell better
const KEPT = 0.85; // weight of what earlier drawings tell, when another is added
const SPREAD = 0.3; // of the sizes of drawings, as a part, that is needed to tell both parts from each other
const LEAST_MS = 8; // that pixels may take where the other part alone is too long

export class DrawSpeed {
  #sums = { weight: 0, pixels: 0, ms: 0, square: 0, product: 0 };
  #fixedMs = 0;
  #msPerPixel = FIRST_MS_PER_PIXEL;

  /** Take over how long a drawing took. */
  add(pixels, ms) {
    const sums = this.#sums;
    for (const [name, value] of Object.entries({ weight: 1, pixels, ms, square: pixels * pixels, product: pixels * ms })) sums[name] = KEPT * sums[name] + value;
    const [size, time] = [sums.pixels / sums.weight, sums.ms / sums.weight];
    const doubt = (SPREAD * size) ** 2;
    const slope = (sums.product / sums.weight - size * time + doubt * this.#msPerPixel) / (sums.square / sums.weight - size * size + doubt);
    this.#msPerPixel = Math.min(Math.max(slope, 0.01 * (time / size)), time / size);
    this.#fixedMs = time - this.#msPerPixel * size;
  }

  /** Return how many pixels are drawn in some milliseconds. */
  pixelsIn(ms) {
    return Math.max(ms - this.#fixedMs, LEAST_MS) / this.#msPerPixel;
  }
}
