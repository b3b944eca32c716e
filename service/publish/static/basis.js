/** How much each plane counts under a light: the stored basis, interpolated between the captured lights (type `rbf` of the relight format). */

const LEAST = 1e-3; // weights up to this count nothing

/** The basis of an info.json. */
export class Basis {
  constructor({ lights, sigma, basis, nplanes, materials: [{ range, scale, bias }] }) {
    const count = lights.length / 3;
    [this.lights, this.sigma, this.planes] = [lights, sigma, nplanes];
    this.values = Float32Array.from({ length: 3 * nplanes * count }, (_, at) => (basis[3 * count + at] - 127) / range[Math.floor(at / (3 * count))]);
    [this.scale, this.bias] = [scale, bias];
  }

  /** Return the weight of each captured light, as [light, weight] of those that count, in a light from a unit vector. */
  weights([x, y, z]) {
    const squares = Array.from({ length: this.lights.length / 3 }, (_, light) => (this.lights[3 * light] - x) ** 2 + (this.lights[3 * light + 1] - y) ** 2 + (this.lights[3 * light + 2] - z) ** 2);
    const nearest = Math.min(...squares); // which all are relative to, so that none but the farthest vanish
    const found = squares.map((square, light) => [light, Math.exp((nearest - square) / this.sigma ** 2)]);
    const sum = (each) => each.reduce((total, [, weight]) => total + weight, 0);
    const all = sum(found);
    const kept = found.filter(([, weight]) => weight > LEAST * all);
    const rest = sum(kept);
    return kept.map(([light, weight]) => [light, weight / rest]);
  }

  /**
   * Return what the images of planes are multiplied by under a light, a 3 × 3 matrix each, and what is added.
   * @param {number[]} direction Unit vector to the light, x right, y up, z towards the camera.
   */
  sums(direction, gain) {
    const factor = new Float32Array(3 * this.planes);
    const constant = [0, 0, 0];
    const lights = this.lights.length / 3;
    const weights = this.weights(direction);
    for (let plane = 0; plane < this.planes; plane += 1) {
      for (let c = 0; c < 3; c += 1) {
        const value = weights.reduce((sum, [light, weight]) => sum + weight * this.values[3 * (plane * lights + light) + c], 0);
        factor[3 * plane + c] = gain * value * this.scale[plane];
        constant[c] -= factor[3 * plane + c] * this.bias[plane];
      }
    }
    return { factor, constant };
  }
}
