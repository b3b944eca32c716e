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
 * @param {Set<number>} held Lights to hold at zero at first; afterwards those that are. The weights do not depend on it, but come soonest from
 * the lights that were held for light like this.
 * @returns {Float64Array} [lights]
 */
export function quadratureWeights(inverse, count, moments, held) {
  const across = count + 1;
  const best = new Float64Array(count);
  for (let row = 0; row < count; row += 1) for (let col = 0; col < across; col += 1) best[row] += inverse[row * across + col] * moments[col];
  let [fewest, patience] = [count + 1, PATIENCE];
  const weights = best.slice();
  for (let exchange = 0; exchange < MOST_EXCHANGES; exchange += 1) {
    const lights = Int32Array.from(held).sort();
    const force = solve(inverse, across, lights, best);
    weights.set(best);
    lights.forEach((light, index) => { for (let row = 0; row < count; row += 1) weights[row] += inverse[light * across + row] * force[index]; });
    const signs = weights.slice();
    lights.forEach((light, index) => { signs[light] = force[index]; weights[light] = 0; });
    let wrong = [...signs.keys()].filter((light) => signs[light] < -ROUNDING);
    if (wrong.length === 0) break;
    if (wrong.length < fewest) [fewest, patience] = [wrong.length, PATIENCE];
    else if (patience > 0) patience -= 1;
    else wrong = wrong.slice(-1);
    for (const light of wrong) if (!held.delete(light)) held.add(light);
  }
  const positive = weights.map((weight) => Math.max(0, weight));
  const sum = positive.reduce((a, b) => a + b, 0);
  return positive.map((weight) => weight / sum);
}

/** Return the forces [held] that make the weights of held lights zero, by Cholesky's factors: the covariance left of some lights is positive definite. */
function solve(inverse, across, held, best) {
  const count = held.length;
  const factor = new Float64Array(count * count);
  const found = new Float64Array(count);
  for (let row = 0; row < count; row += 1) {
    let right = -best[held[row]];
    for (let col = 0; col <= row; col += 1) {
      let value = inverse[held[row] * across + held[col]];
      for (let k = 0; k < col; k += 1) value -= factor[row * count + k] * factor[col * count + k];
      factor[row * count + col] = col === row ? Math.sqrt(value) : value / factor[col * count + col];
      if (col < row) right -= factor[row * count + col] * found[col];
    }
    found[row] = right / factor[row * count + row];
  }
  for (let row = count - 1; row >= 0; row -= 1) {
    for (let k = row + 1; k < count; k += 1) found[row] -= factor[k * count + row] * found[k];
    found[row] /= factor[row * count + row];
  }
  return found;
}
