/** Light from a disc on the sphere, as directions spread evenly over it (Vogel 1979). */

const MIN_SAMPLES = 64;
const GOLDEN = Math.PI * (3 - Math.sqrt(5));

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
