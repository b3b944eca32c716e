/** An environment map as energy over directions, as light_model.js takes it. */

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
