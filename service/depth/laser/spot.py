"""Point-based range finding: where a laser spot is in the image, and where its ray meets the line of sight.

The pixels that hang together with the peak give a first centre and the width; a second, weaker spot (a reflection) and noise elsewhere
take no part. The centre is then where the centroid under a Gaussian of that width is the Gaussian's middle: it has no cut edges, which
would pull it by hundredths of a pixel. One spot a frame is little work, so this is NumPy on the host.
"""

from typing import NamedTuple

import numpy as np
from scipy.ndimage import label, map_coordinates, uniform_filter

from kernels.status import Status
from service.depth.laser.background import background

LEVEL = 0.15
"""Part of the peak above which a pixel counts towards the first centre and the width."""
MIN_WINDOW_PX = 1.5
"""Least standard deviation of the Gaussian window, pixels: whole pixels do not sample a narrower one well."""
STEPS = 10
"""Number of Newton steps; a Gaussian spot takes one, a saturated one about four."""
ODD_SHARE = 0.7
"""Part of the noise that odd residuals show: they are halves of differences, interpolated between pixels."""
LEAST_GAIN = 0.1
"""Least slope of Newton's step, 1 - variance under the window / variance of the window, that is divided by: a Gaussian spot has 0.5."""
NOISE_FACTOR = 8.0
"""Least height of a spot, in standard deviations of the noise: among 10⁷ pixels noise alone reaches 5.3."""
REACH_PX = 64
"""Half the side of the window in which a spot lies, pixels: a larger blot is not a spot."""
PARALLEL = 1e-6
"""Least squared sine of the angle between two rays that meet in a point: 0.06 degrees."""


class Spot(NamedTuple):
    """One laser spot."""

    u: float  # continuous image coordinates of its centroid
    v: float
    sigma_px: float  # standard deviation of the centroid in either direction, from the noise of the image and the spot's unevenness
    amplitude: float  # peak, in the unit of the image
    status: int  # kernels.status.Status: OK, or LOW_MODULATION and the rest is 0


class Meeting(NamedTuple):
    """The place where two rays come closest."""

    point: np.ndarray  # [n, 3] midway between the two
    gap: np.ndarray  # [n] metres between the rays: the residual
    along_a: np.ndarray  # [n] metres along the first ray, negative behind its origin
    along_b: np.ndarray  # [n] the same of the second
    angle: np.ndarray  # [n] radians between the rays


def find_spot(signal: np.ndarray) -> Spot:
    """Return the sub-pixel centroid of the brightest spot; LOW_MODULATION when none stands out of the noise.

    Args:
        signal: [rows, cols] float32, the frame less its background; what is not to be looked at is NaN.

    Source:
        The mean shift of Comaniciu and Meer, TPAMI 2002, equation 20, divided by its slope.
    """
    none = Spot(0.0, 0.0, 0.0, 0.0, int(Status.LOW_MODULATION))
    valid = np.isfinite(signal)
    if not valid.any():
        return none
    values = np.where(valid, signal, 0)
    sample = values[valid][:: max(1, valid.sum() // 100_000)]
    middle, noise = background(sample, 1e-7 * float(np.abs(values).max()))
    values = np.where(valid, signal - middle, 0)
    row, col = (int(at) for at in np.unravel_index(int(np.argmax(_blurred(values))), values.shape))
    if values[row, col] <= 0 or _blurred(values[max(row - 1, 0):row + 2, max(col - 1, 0):col + 2]).max() < NOISE_FACTOR * noise / 3:
        return none
    top, left = max(row - REACH_PX, 0), max(col - REACH_PX, 0)
    window = values[top:row + REACH_PX + 1, left:col + REACH_PX + 1]
    near = slice(max(row - top - 1, 0), row - top + 2), slice(max(col - left - 1, 0), col - left + 2)
    peak = float(window[near].max())
    if peak < NOISE_FACTOR * noise:
        return none
    # at least two noises above nothing, so that the spot does not run out into the noise
    floor = max(LEVEL * peak, 2 * noise)
    parts, _ = label(window > floor, np.ones((3, 3)))
    inside = np.isin(parts, parts[near][parts[near] > 0])
    weight = np.where(inside, window - floor, 0).astype(np.float64)
    total = weight.sum()
    if total <= 0:
        return none
    rows, cols = np.indices(window.shape)
    centre = np.array([(rows * weight).sum(), (cols * weight).sum()]) / total
    square = ((rows - centre[0]) ** 2 * weight).sum() + ((cols - centre[1]) ** 2 * weight).sum()
    width = max(float(np.sqrt(square / total / 2)), MIN_WINDOW_PX)
    error = 0.0
    for _ in range(STEPS):
        off = np.stack([rows - centre[0], cols - centre[1]])
        gauss = np.exp(-0.5 * (off**2).sum(axis=0) / width**2)
        under = gauss * window
        mass = under.sum()
        if mass <= 0:
            return none
        shift = (off * under).sum(axis=(1, 2)) / mass
        gain = np.maximum(1 - ((off**2 * under).sum(axis=(1, 2)) / mass - shift**2) / width**2, LEAST_GAIN)
        centre = centre + np.clip(shift / gain, -width, width)
        error = float(noise * np.sqrt(((gauss * off) ** 2).sum() / 2) / (mass * gain.min()))
    texture = _uneven(window, centre, width) / float(gain.min())
    return Spot(float(left + centre[1] + 0.5), float(top + centre[0] + 0.5), max(error, texture), peak, int(Status.OK))


def _uneven(window: np.ndarray, centre: np.ndarray, width: float) -> float:
    """Return the standard deviation of the centroid that odd residuals show, pixels, noise included.

    Texture brightens one side of the spot and not the other. The residual of each pixel from the Gaussian with the same moments, less that
    of the place mirrored in the centre, is taken for an error (White, Econometrica 48, 1980) that blocks of two pixels or of the spot's
    width share.
    """
    rows, cols = np.indices(window.shape)
    off = np.stack([rows - centre[0], cols - centre[1]])
    square = (off**2).sum(axis=0)
    gauss = np.exp(-0.5 * square / width**2)
    mass = float((gauss * window).sum())
    inner = float((square * gauss * window).sum()) / mass / 2  # variance along either axis, under the window
    own = 1 / max(1 / max(inner, 0.01) - 1 / width**2, 1 / (2 * REACH_PX) ** 2)
    shape = np.exp(-0.5 * square / own)
    left = window - mass / float((gauss * shape).sum()) * shape
    mirror = 2 * centre[:, None, None] - np.stack([rows, cols])
    inside = ((mirror >= 0) & (mirror < np.array(window.shape)[:, None, None] - 1)).all(axis=0)
    odd = np.where(inside, 0.5 * (left - map_coordinates(left, mirror, order=1)), 0)
    side = max(2, round(width))
    blocks = (rows // side) * (window.shape[1] // side + 1) + cols // side
    pulls = [np.bincount(blocks.ravel(), weights=(axis * gauss * odd).ravel()) for axis in off]
    return float(np.sqrt(sum((pull**2).sum() for pull in pulls)) / (ODD_SHARE * mass))


def nearest_points(origins_a: np.ndarray, directions_a: np.ndarray, origins_b: np.ndarray, directions_b: np.ndarray) -> Meeting:
    """Return the points with the least sum of squared distances to two rays each; NaN where the rays are parallel.

    Args:
        origins_a: [n, 3] or [3], metres. directions_a: [n, 3], of any length. The same of b.

    Source:
        Sunday, "Practical Geometry Algorithms", 2021, distance between lines: the 2×2 normal equations in closed form.
    """
    a, b = (rays / np.linalg.norm(rays, axis=-1, keepdims=True) for rays in (directions_a, directions_b))
    between = np.broadcast_to(np.asarray(origins_b, float) - origins_a, a.shape)
    cosine = (a * b).sum(axis=-1)
    sine2 = (np.cross(a, b) ** 2).sum(axis=-1)
    safe = np.where(sine2 > PARALLEL, sine2, np.nan)
    on_a, on_b = (between * a).sum(axis=-1), (between * b).sum(axis=-1)
    along_a, along_b = (on_a - cosine * on_b) / safe, (cosine * on_a - on_b) / safe
    first, second = origins_a + along_a[..., None] * a, origins_b + along_b[..., None] * b
    angle = np.arcsin(np.sqrt(np.minimum(sine2, 1)))
    return Meeting((first + second) / 2, np.linalg.norm(first - second, axis=-1), along_a, along_b, angle)


def _blurred(values: np.ndarray) -> np.ndarray:
    """Return the mean of 3×3 pixels, with zeros outside: it lowers a hot pixel below a spot."""
    return np.asarray(uniform_filter(values, 3, mode="constant"))
