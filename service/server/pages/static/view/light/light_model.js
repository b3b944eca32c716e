/**
 * From light to the coefficients of a reduced basis (docs/view.md): light is shared out over the captured lights as `relit relight` does, and
 * the coefficients of each tile are those of the captured images, each times the energy of its light.
 *
 * Directions are those of environment maps: +y at the top, +z in the middle, +x a quarter from the left edge.
 */

import { floats } from "../view_file.js";
import { discSamples } from "./disc_light.js";
import { covariance, quadratureWeights } from "./kernel_quadrature.js";

const WHOLE = 1 - 1e-6; // but for rounding
const SAME = 1e-13; // moments of light whose energy is one differ by rounding

/** Light as sums over its directions, in three channels. */
class LightSum {
  constructor(lights) {
    this.moments = [0, 1, 2].map(() => new Float64Array(lights + 1));
    this.outside = [0, 1, 2].map(() => new Float64Array(lights));
    this.energy = 0;
    this.energyBeyond = 0;
  }
}

/** The captured lights, and how other light is shared out over them. */
export class LightModel {
  /**
   * @param {any} relight Of view.json.
   * @param {{inverse: Float64Array, beyond: Float32Array, outside: Float32Array, captured: Uint16Array}} tables Blocks of that name; `captured` are half floats.
   * @param {{direction: number[], irradiance: number[]}[]} lights All captured lights, in the order of `captured`.
   */
  constructor(relight, tables, lights) {
    this.each = 3 * relight.terms * relight.tiles.count; // coefficients of a captured image
    this.scale = relight.scale;
    [this.cols, this.rows] = relight.directions;
    this.range = relight.quadrature.range;
    this.kept = relight.quadrature.kept;
    this.tables = tables;
    this.lights = lights;
    this.held = [0, 1, 2].map(() => new Set()); // lights without weight in the light before, by channel
    this.captured = []; // images that were needed so far, decoded
    this.covariances = null; // of every cell of the grid with every light
  }

  /** Return the number of cells of the grid of directions. */
  get cells() {
    return this.rows * this.cols;
  }

  /**
   * Sum up light.
   * @param {{direction: number[], irradiance: number[], angle_degrees: number}|null} disc As in light keys.
   * @param {Float64Array|null} energy [cells, 3] of an environment.
   * @returns {LightSum}
   */
  sum(disc, energy) {
    const sum = new LightSum(this.kept.length);
    if (disc !== null) this.#addDisc(sum, disc);
    if (energy !== null) this.#addCells(sum, energy);
    return sum;
  }

  /** Return the coefficients [tiles, terms, 3] of light. */
  coefficients(sum) {
    let [before, weights] = [null, null];
    const energies = sum.outside.map((outside, channel) => {
      const whole = sum.moments[channel].at(-1);
      if (!(whole > 0)) return outside;
      const moments = sum.moments[channel].map((moment) => moment / whole);
      const isSame = before?.every((moment, index) => Math.abs(moment - moments[index]) < SAME) ?? false; // as of light of one colour
      if (!isSame) weights = quadratureWeights(this.tables.inverse, this.kept.length, moments, this.held[channel]);
      before = moments;
      return outside.map((energy, index) => energy + whole * weights[index]);
    });
    const found = new Float32Array(this.each);
    this.kept.forEach((light, index) => this.#add(found, light, energies.map((each, channel) => each[index] / this.lights[light].irradiance[channel])));
    return found;
  }

  /** Return the coefficients [tiles, terms, 3] of the sum of the captured images, each times a weight in each channel. */
  ofCaptured(weights) {
    return weights.reduce((found, weight, light) => this.#add(found, light, weight), new Float32Array(this.each));
  }

  /** Return the coefficients [tiles, terms, 3] of a captured image. */
  capturedImage(light) {
    return this.#add(new Float32Array(this.each), light, [1, 1, 1]);
  }

  /** Add a captured image times a weight in each channel. */
  #add(found, light, weights) {
    if (weights.every((weight) => weight === 0)) return found;
    this.captured[light] ??= floats(this.tables.captured.slice(light * this.each, (light + 1) * this.each).buffer, "float16");
    addWeighted(found, this.captured[light], weights.map((weight) => weight * this.scale));
    return found;
  }

  /** Return the share of light that comes from wholly beyond the captured lights, 0 to 1. */
  shareBeyond(sum) {
    return sum.energy > 0 ? sum.energyBeyond / sum.energy : 0;
  }

  /** Return whether a direction lies wholly beyond the captured lights. */
  isBeyond(direction) {
    const [col, row] = this.#cellOf(direction);
    return this.tables.beyond[Math.min(this.rows - 1, Math.floor(row)) * this.cols + (Math.floor(col) % this.cols)] >= WHOLE;
  }

  /**
   * Return the energy [cells, 3] of an environment that is turned about +y, from +z towards +x.
   * @param {EnvironmentProfile} profile
   */
  turned(profile, turnDegrees, gain) {
    const energy = new Float64Array(3 * this.cells);
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
    return energy;
  }

  /** Add a disc of even radiance. */
  #addDisc(sum, { direction, irradiance, angle_degrees: angle }) {
    const samples = discSamples(direction, angle);
    const whole = 2 / (1 + Math.cos((angle * Math.PI) / 360)) / samples.length; // so that a facing surface gets the irradiance
    const energy = irradiance.map((each) => whole * each);
    for (const sample of samples) {
      const around = this.#cellsAround(sample);
      const beyond = around.reduce((total, [cell, part]) => total + part * this.tables.beyond[cell], 0);
      this.#count(sum, energy, beyond);
      this.kept.forEach((light, index) => {
        const kernel = beyond < 1 ? (1 - beyond) * covariance(dot(sample, this.lights[light].direction), this.range) : 0;
        const share = beyond > 0 ? around.reduce((total, [cell, part]) => total + part * this.tables.outside[cell * this.kept.length + index], 0) : 0;
        for (let channel = 0; channel < 3; channel += 1) {
          sum.moments[channel][index] += energy[channel] * kernel;
          sum.outside[channel][index] += energy[channel] * share;
        }
      });
    }
  }

  #addCells(sum, energy) {
    const count = this.kept.length;
    this.covariances ??= this.#cellCovariances();
    for (let cell = 0; cell < this.cells; cell += 1) {
      const here = energy.subarray(3 * cell, 3 * cell + 3);
      if (here[0] === 0 && here[1] === 0 && here[2] === 0) continue;
      const beyond = this.tables.beyond[cell];
      this.#count(sum, here, beyond);
      for (let channel = 0; channel < 3; channel += 1) {
        const [moments, outside] = [sum.moments[channel], sum.outside[channel]];
        const inside = here[channel] * (1 - beyond);
        for (let index = 0, at = cell * count; index < count; index += 1, at += 1) {
          moments[index] += inside * this.covariances[at];
          outside[index] += here[channel] * this.tables.outside[at];
        }
      }
    }
  }

  #count(sum, energy, beyond) {
    const all = energy[0] + energy[1] + energy[2];
    sum.energy += all;
    if (beyond >= WHOLE) sum.energyBeyond += all;
    for (let channel = 0; channel < 3; channel += 1) sum.moments[channel][this.kept.length] += energy[channel] * (1 - beyond);
  }

  #cellCovariances() {
    const found = new Float32Array(this.cells * this.kept.length);
    for (let cell = 0, at = 0; cell < this.cells; cell += 1) {
      const [polar, azimuth] = [(Math.PI * (Math.floor(cell / this.cols) + 0.5)) / this.rows, (2 * Math.PI * ((cell % this.cols) + 0.5)) / this.cols];
      const direction = [Math.sin(azimuth) * Math.sin(polar), Math.cos(polar), -Math.cos(azimuth) * Math.sin(polar)];
      for (const light of this.kept) {
        found[at] = covariance(dot(direction, this.lights[light].direction), this.range);
        at += 1;
      }
    }
    return found;
  }

  /** Return the four cells around a direction, with the part of each. */
  #cellsAround(direction) {
    const [col, row] = this.#cellOf(direction).map((place) => place - 0.5);
    const [left, top] = [Math.floor(col), Math.floor(row)];
    const found = [];
    for (const [r, down] of [[top, 1 - (row - top)], [top + 1, row - top]]) {
      for (const [c, across] of [[left, 1 - (col - left)], [left + 1, col - left]]) {
        found.push([Math.max(0, Math.min(this.rows - 1, r)) * this.cols + ((c % this.cols) + this.cols) % this.cols, down * across]);
      }
    }
    return found;
  }

  #cellOf([x, y, z]) {
    const u = (Math.atan2(x, -z) / (2 * Math.PI) + 1) % 1;
    const v = Math.acos(Math.max(-1, Math.min(1, y))) / Math.PI;
    return [u * this.cols, v * this.rows];
  }
}

/**
 * Add colours times a weight in each channel to others.
 * @param {Float32Array} found [n, 3]
 * @param {Float32Array} colours [n, 3]
 * @param {number[]} weights [3]
 */
function addWeighted(found, colours, [red, green, blue]) {
  for (let at = 0; at < colours.length; at += 3) {
    found[at] += red * colours[at];
    found[at + 1] += green * colours[at + 1];
    found[at + 2] += blue * colours[at + 2];
  }
}

function dot(a, b) {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}
