/**
 * Shares light out over the captured lights by kernel quadrature, as `relit relight --weights kernel` does
 * (service/relight/weights/quadrature.py has the sources): the energies of least expected error that are not negative.
 */

const ROUNDING = 1e-9;
const PATIENCE = 5;
const MOST_EXCHANGES = 1000;

/** Return Matérn's covariance of smoothness 3/2 between two unit vectors whose cosine is given. */
export function covariance(cosine, range) {
  const scaled = (Math.sqrt(3) / range) * Math.sqrt(Math.max(0, 2 - 2 * cosine));
  return (1 + scaled) * Math.exp(-scaled);
}

/**
 * Return the weights of least expected error that are not negative; they sum to one.
 * @param {Float64Array} inverse [lights + 1, lights + 1] of the bordered covariance.
 * @param {number} count Of the lights.
 * @param {Float64Array} moments [lights + 1], of light whose energy is one.
 * @returns {Float64Array} [lights]
 */
export function quadratureWeights(inverse, count, moments) {
  const at = (row, col) => inverse[row * (count + 1) + col];
  const best = Float64Array.from({ length: count }, (_, row) => moments.reduce((sum, moment, col) => sum + at(row, col) * moment, 0));
  const held = new Set();
  let [fewest, patience] = [count + 1, PATIENCE];
  let weights = best;
  for (let exchange = 0; exchange < MOST_EXCHANGES; exchange += 1) {
    const lights = [...held].sort((a, b) => a - b);
    const force = solve(lights.map((row) => lights.map((col) => at(row, col))), lights.map((light) => -best[light]));
    weights = best.map((value, row) => lights.reduce((sum, light, index) => sum + at(row, light) * force[index], value));
    const signs = weights.slice();
    lights.forEach((light, index) => { signs[light] = force[index]; weights[light] = 0; });
    let wrong = [...signs.keys()].filter((light) => signs[light] < -ROUNDING);
    if (wrong.length === 0) break;
    if (wrong.length < fewest) [fewest, patience] = [wrong.length, PATIENCE];
    else if (patience > 0) patience -= 1;
    else wrong = wrong.slice(-1);
    for (const light of wrong) if (!held.delete(light)) held.add(light);
  }
  weights = weights.map((weight) => Math.max(0, weight));
  const sum = weights.reduce((a, b) => a + b, 0);
  return weights.map((weight) => weight / sum);
}

/** Return the solution of a dense system, by elimination with pivots. */
function solve(matrix, right) {
  const count = right.length;
  const rows = matrix.map((row, index) => Float64Array.from([...row, right[index]]));
  for (let col = 0; col < count; col += 1) {
    let pivot = col;
    for (let row = col + 1; row < count; row += 1) if (Math.abs(rows[row][col]) > Math.abs(rows[pivot][col])) pivot = row;
    [rows[col], rows[pivot]] = [rows[pivot], rows[col]];
    for (let row = col + 1; row < count; row += 1) {
      const factor = rows[row][col] / rows[col][col];
      if (factor !== 0) for (let k = col; k <= count; k += 1) rows[row][k] -= factor * rows[col][k];
    }
  }
  const found = new Float64Array(count);
  for (let row = count - 1; row >= 0; row -= 1) {
    let value = rows[row][count];
    for (let col = row + 1; col < count; col += 1) value -= rows[row][col] * found[col];
    found[row] = value / rows[row][row];
  }
  return found;
}
