/**
 * From light to the coefficients of a reduced basis (docs/view.md): a frame is the sum of the coefficient images, each times its coefficient,
 * which is the sum over directions of energy times the table `transfer`.
 *
 * Directions are those of environment maps: +y at the top, +z in the middle, +x a quarter from the left edge.
 */

const MIN_SAMPLES = 64;
const GOLDEN = Math.PI * (3 - Math.sqrt(5));

/** Table from directions to coefficients, and which directions lie beyond the captured lights. */
export class LightModel {
  /**
   * @param {{terms: number, directions: [number, number]}} relight Of view.json.
   * @param {Float32Array} transfer [rows, cols, terms, 3]
   * @param {Uint8Array} beyond [rows, cols], 255 beyond the captured lights
   */
  constructor(relight, transfer, beyond) {
    this.terms = relight.terms;
    [this.cols, this.rows] = relight.directions;
    this.transfer = transfer;
    this.beyond = beyond;
  }

  /** Return the number of cells of the grid of directions. */
  get cells() {
    return this.rows * this.cols;
  }

  /** Return the coefficients [terms, 3] of an energy [cells, 3]. */
  coefficients(energy) {
    const found = new Float32Array(3 * this.terms);
    for (let cell = 0; cell < this.cells; cell += 1) {
      const [r, g, b] = [energy[3 * cell], energy[3 * cell + 1], energy[3 * cell + 2]];
      if (r === 0 && g === 0 && b === 0) continue;
      for (let k = 0, at = 3 * this.terms * cell; k < 3 * this.terms; k += 3, at += 3) {
        found[k] += r * this.transfer[at];
        found[k + 1] += g * this.transfer[at + 1];
        found[k + 2] += b * this.transfer[at + 2];
      }
    }
    return found;
  }

  /** Return the share of an energy [cells, 3] that comes from beyond the captured lights, 0 to 1. */
  shareBeyond(energy) {
    let [outside, all] = [0, 0];
    for (let cell = 0; cell < this.cells; cell += 1) {
      const here = energy[3 * cell] + energy[3 * cell + 1] + energy[3 * cell + 2];
      all += here;
      if (this.beyond[cell] === 255) outside += here;
    }
    return all > 0 ? outside / all : 0;
  }

  /** Return whether a direction lies beyond the captured lights. */
  isBeyond(direction) {
    const [col, row] = this.#cellOf(direction);
    return this.beyond[Math.min(this.rows - 1, Math.floor(row)) * this.cols + (Math.floor(col) % this.cols)] === 255;
  }

  /**
   * Add a disc of even radiance to an energy [cells, 3]; each sample is shared by the four cells around it.
   * @param {Float64Array} energy
   * @param {{direction: number[], irradiance: number[], angle_degrees: number}} light As in light keys.
   */
  addDisc(energy, { direction, irradiance, angle_degrees: angle }) {
    const samples = discSamples(direction, angle);
    const whole = 2 / (1 + Math.cos((angle * Math.PI) / 360)) / samples.length; // so that a facing surface gets the irradiance
    for (const sample of samples) {
      const [col, row] = this.#cellOf(sample).map((place) => place - 0.5);
      const [left, top] = [Math.floor(col), Math.floor(row)];
      for (const [r, down] of [[top, 1 - (row - top)], [top + 1, row - top]]) {
        for (const [c, across] of [[left, 1 - (col - left)], [left + 1, col - left]]) {
          const cell = Math.max(0, Math.min(this.rows - 1, r)) * this.cols + ((c % this.cols) + this.cols) % this.cols;
          for (let channel = 0; channel < 3; channel += 1) energy[3 * cell + channel] += whole * down * across * irradiance[channel];
        }
      }
    }
  }

  /**
   * Add an environment map to an energy [cells, 3].
   * @param {Float64Array} energy
   * @param {EnvironmentProfile} profile
   * @param {number} turnDegrees About +y, from +z towards +x.
   * @param {number} gain
   */
  addEnvironment(energy, profile, turnDegrees, gain) {
    const shift = (((-turnDegrees / 360) % 1) + 1) % 1;
    const { cols } = profile;
    for (let col = 0; col < cols; col += 1) {
      const place = ((col + 0.5) / cols + shift) * this.cols - 0.5;
      const left = Math.floor(place);
      for (const [cell, part] of [[left, 1 - (place - left)], [left + 1, place - left]]) {
        const column = ((cell % this.cols) + this.cols) % this.cols;
        for (let row = 0; row < this.rows; row += 1) {
          const from = 3 * (row * cols + col);
          const to = 3 * (row * this.cols + column);
          for (let channel = 0; channel < 3; channel += 1) energy[to + channel] += gain * part * profile.energy[from + channel];
        }
      }
    }
  }

  #cellOf([x, y, z]) {
    const u = (Math.atan2(x, -z) / (2 * Math.PI) + 1) % 1;
    const v = Math.acos(Math.max(-1, Math.min(1, y))) / Math.PI;
    return [u * this.cols, v * this.rows];
  }
}

/** The energy of an environment map in rows as high as the grid's, whose columns can be turned. */
export class EnvironmentProfile {
  /**
   * @param {{rows: number, cols: number, pixels: Float32Array}} map Radiance [rows, cols, 3], linear.
   * @param {number} rows Of the grid.
   */
  constructor(map, rows) {
    this.cols = map.cols;
    this.energy = new Float64Array(3 * rows * map.cols);
    for (let row = 0; row < map.rows; row += 1) {
      const polar = (Math.PI * (row + 0.5)) / map.rows;
      const solidAngle = Math.sin(polar) * (Math.PI / map.rows) * ((2 * Math.PI) / map.cols);
      const place = ((row + 0.5) / map.rows) * rows - 0.5; // shared by the two nearest rows of the grid
      const top = Math.floor(place);
      for (const [to, part] of [[top, 1 - (place - top)], [top + 1, place - top]]) {
        const into = 3 * Math.max(0, Math.min(rows - 1, to)) * map.cols;
        for (let at = 0; at < 3 * map.cols; at += 1) this.energy[into + at] += part * solidAngle * map.pixels[3 * row * map.cols + at];
      }
    }
  }
}

/** Return directions spread evenly over a disc on the sphere (Vogel 1979). */
export function discSamples(direction, angleDegrees) {
  const low = 2 * Math.sin((angleDegrees * Math.PI) / 720) ** 2;
  const count = Math.max(MIN_SAMPLES, Math.ceil((2 * Math.PI * low) / (Math.PI / 90) ** 2));
  const axis = direction.map(Math.abs);
  const helper = [0, 0, 0];
  helper[axis.indexOf(Math.min(...axis))] = 1;
  const x = unit(cross(direction, helper));
  const y = cross(direction, x);
  return Array.from({ length: count }, (_, index) => {
    const fall = ((index + 0.5) / count) * low;
    const across = Math.sqrt(fall * (2 - fall));
    const turn = (index + 0.5) * GOLDEN;
    return [0, 1, 2].map((c) => across * Math.cos(turn) * x[c] + across * Math.sin(turn) * y[c] + (1 - fall) * direction[c]);
  });
}

/** Return a vector of length one. */
export function unit(vector) {
  const length = Math.hypot(...vector);
  return vector.map((each) => each / length);
}

function cross(a, b) {
  return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
}
