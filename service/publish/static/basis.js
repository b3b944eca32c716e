/** How much each plane counts under a light: the stored grid of directions, interpolated (type `bilinear` of the relight format). */

/** The basis of an info.json. */
export class Basis {
  constructor({ resolution, basis, nplanes, materials: [{ range, scale, bias }] }) {
    const count = 3 * resolution ** 2;
    [this.side, this.planes] = [resolution, nplanes];
    this.values = Float32Array.from({ length: nplanes * count }, (_, at) => (basis[count + at] - 127) / range[Math.floor(at / count)]);
    [this.scale, this.bias] = [scale, bias];
  }

  /** Return the four directions of the grid, as [place, weight], around a unit vector: the upper half of an octahedron, turned by 45 degrees. */
  weights([x, y, z]) {
    const sum = Math.abs(x) + Math.abs(y) + Math.abs(z);
    const [u, v] = [x + y, y - x].map((part) => (part / sum + 1) / 2 * (this.side - 1));
    const [column, row] = [u, v].map((place) => Math.min(this.side - 2, Math.max(0, Math.floor(place))));
    return [0, 1, 2, 3].map((corner) => {
      const [right, below] = [corner & 1, corner >> 1];
      return [column + right + (row + below) * this.side, Math.abs(1 - right - (u - column)) * Math.abs(1 - below - (v - row))];
    });
  }

  /**
   * Return what the images of planes are multiplied by under a light, a 3 × 3 matrix each, and what is added.
   * @param {number[]} direction Unit vector to the light, x right, y up, z towards the camera.
   */
  sums(direction, gain) {
    const factor = new Float32Array(3 * this.planes);
    const constant = [0, 0, 0];
    const weights = this.weights(direction);
    for (let plane = 0; plane < this.planes; plane += 1) {
      for (let c = 0; c < 3; c += 1) {
        const value = weights.reduce((sum, [place, weight]) => sum + weight * this.values[3 * (plane * this.side ** 2 + place) + c], 0);
        factor[3 * plane + c] = gain * value * this.scale[plane];
        constant[c] -= factor[3 * plane + c] * this.bias[plane];
      }
    }
    return { factor, constant };
  }
}
