"""The matrix from the colours of a camera to those of a chart: which patches tell it, whether the response is linear, and how well it fits.

Which patches lie in shadow or gloss is told without knowing the matrix: chromaticities alone give a homography to those of the reference,
and with it the light on each patch, which is to be even, or to fall evenly over the chart. The matrix then has the least sum of squares in
CIELAB, beginning with the linear least squares.

Source: Finlayson, Gong and Fisher, "Color homography: theory and applications", IEEE TPAMI 41(1), 2019 (shading and matrix of a chart).
"""

from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from service.calibrate.solvers.chart_patches import PatchPlaces
from service.calibrate.solvers.chart_reference import ChartReference
from service.calibrate.solvers.cielab import WHITES, delta_e_2000, lab_from_xyz
from stage.errors import CalibrationError

CLIPPED = 0.005
"""The part of a patch's pixels that may be saturated: a few pixels of a sensor always are."""
UNEVEN = 0.2
"""The largest difference between the quarters of a patch, over its mean, beyond what noise explains."""
OFF = 0.18
"""The logarithm by which the light on a patch may differ from that around it: metamers of real cameras differ by half of it."""
SIGMAS = 4.0
"""Standard errors that count as noise."""
MOST_FALL = 2.0
"""The largest ratio between the light at two ends of the chart: with more, patches are as much noise as colour."""
HALF_SHADOW = 0.7
"""The light on one half of the chart over that on the other, beyond an even fall, below which an edge of shadow lies between them.
Without any shadow, spectra of the patches in two real cameras give 0.82 or more under daylight, 0.75 under a sodium lamp."""
DIRECTIONS = 8
"""The number of directions in which such an edge is sought."""
NEUTRAL_CHROMA = 5.0
"""Patches with less chroma are grey."""
LEAST_GREYS = 3
NAMED = 6
"""The most patches that an error names."""
LEAST_PART = 0.6
"""The part of the patches that is needed: of fewer, light and colour cannot be told apart."""
GAMMA_NOTED, GAMMA_REFUSED = 0.03, 0.2
"""The deviation of the exponent of the response from 1 that is a finding, and that from which no matrix is sought."""
LEAST_COLOURS = 0.02
"""The third singular value of the chromaticities over the first, below which the light shows fewer than three colours."""
MOST_ANGLE = 6.0
"""The median angle, degrees, between colours through the homography and those of the chart, from which it is another chart, or none."""
DIM = 0.1
"""A frame that shows the chart with less light than this part of the brightest is not used."""
FALL_NOTED, MISFIT_NOTED = 1.25, 3.0
"""The ratio between the light at two ends of the chart, and the mean CIEDE2000 that the matrix leaves, that are findings."""


class PatchReadings(NamedTuple):
    """The patches of a chart as a camera sees them."""

    value: np.ndarray  # [patches, 3] float64, linear; NaN where a patch is not read
    sigma: np.ndarray  # [patches] standard error of the mean of the channels
    refused: dict[int, str]
    """Why a patch is not read, by its index."""

    def ordered(self, order: np.ndarray) -> "PatchReadings":
        """Return the readings of other patches in their places."""
        place = {int(old): new for new, old in enumerate(order)}
        return PatchReadings(self.value[order], self.sigma[order], {place[index]: why for index, why in self.refused.items()})


class ChartColors(NamedTuple):
    """The colours of a camera by a chart."""

    matrix: np.ndarray  # [3, 3] float64; greys keep the value of their green channel
    gains: np.ndarray  # [3] the factors that make the greys grey, that of green 1
    light: np.ndarray  # [patches] the light on each patch over that on the brightest end, as it falls over the chart
    gamma: float | None
    """The exponent of the response by the grey patches; None: too few are left."""
    refused: dict[int, str]
    """Why a patch is left out, by its index."""
    measured: np.ndarray  # [patches, 3] with the matrix that the capture had, as bright as the reference
    corrected: np.ndarray  # [patches, 3]
    before: np.ndarray  # [patches] CIEDE2000 with the matrix that the capture had
    after: np.ndarray  # [patches]
    findings: tuple[str, ...]

    @property
    def used(self) -> np.ndarray:
        """Return [patches] whether each is used."""
        return np.array([index not in self.refused for index in range(len(self.after))])


def read_patches(places: PatchPlaces, patches: int, radiance: np.ndarray, saturated: np.ndarray | None) -> PatchReadings:
    """Return the readings of one image; radiance [rows, cols, 3] and saturated [rows, cols] or None are the box of the chart."""
    inside = places.label >= 0
    key, pixels = (4 * places.label + places.quarter)[inside], radiance[inside].astype(np.float64)
    count = np.bincount(key, minlength=4 * patches).reshape(patches, 4)

    def sums(values: np.ndarray) -> np.ndarray:
        return np.bincount(key, values, minlength=4 * patches).reshape(patches, 4)

    value = np.stack([sums(channel).sum(axis=1) for channel in pixels.T], axis=1) / count.sum(axis=1)[:, None]
    grey = pixels.mean(axis=1)
    mean = sums(grey) / np.maximum(count, 1)
    noise = np.sqrt(np.maximum(sums(grey**2) / np.maximum(count, 1) - mean**2, 0).mean(axis=1))
    spread = np.where(count > 0, mean, -np.inf).max(axis=1) - np.where(count > 0, mean, np.inf).min(axis=1)
    uneven = spread > UNEVEN * np.abs(mean.mean(axis=1)) + SIGMAS * noise / np.sqrt(np.maximum(count.min(axis=1), 1))
    refused = dict.fromkeys(np.flatnonzero(uneven).tolist(), "unevenly lit")
    if saturated is not None:
        clipped = sums(saturated[inside].astype(np.float64)).sum(axis=1) > CLIPPED * count.sum(axis=1)
        refused |= dict.fromkeys(np.flatnonzero(clipped).tolist(), "clipped")
    value[list(refused)] = np.nan
    return PatchReadings(value, noise / np.sqrt(count.sum(axis=1)), refused)


def combine(frames: list[PatchReadings]) -> PatchReadings:
    """Return one reading of each patch from frames under light of one colour: the median, once each frame is scaled to the others.

    Gloss, which lies elsewhere in each frame, drops out; so do frames in which the chart is dark.
    """
    sums = [frame.value.sum(axis=1) for frame in frames]
    level = np.array([np.nanmedian(each) if np.isfinite(each).any() else 0.0 for each in sums])
    kept = [frame for frame, each in zip(frames, level, strict=True) if each >= DIM * level.max()]
    value = np.stack([frame.value for frame in kept])
    grey = value.sum(axis=2)
    seen = np.isfinite(grey)
    told = seen.any(axis=0)
    scale = np.ones(len(kept))
    for _ in range(3 if len(kept) > 1 else 0):
        common = np.array([np.median(column[ok] / scale[ok]) if ok.any() else np.nan for column, ok in zip(grey.T, seen.T, strict=True)])
        scale = np.array([np.median(row[ok] / common[ok]) if ok.any() else 1.0 for row, ok in zip(grey, seen, strict=True)])
    scaled = value / scale[:, None, None]
    mean = np.full(value.shape[1:], np.nan)
    for index in np.flatnonzero(told):
        mean[index] = np.median(scaled[seen[:, index], index], axis=0)
    refused = {index: next(frame.refused[index] for frame in kept if index in frame.refused) for index in np.flatnonzero(~told).tolist()}
    return PatchReadings(mean, np.median([frame.sigma / each for frame, each in zip(kept, scale, strict=True)], axis=0), refused)


def orient(readings: PatchReadings, reference: np.ndarray, grid: tuple[int, int]) -> tuple[np.ndarray, np.ndarray, int]:
    """Return the order of patches in which a chart shows its colours, and the order of its corners, for it may be turned or mirrored, and
    how many patches have the colours of the chart. Raises CalibrationError if the patches have the colours of the chart in no order, or
    differ in fewer than three colours."""
    columns, rows = grid
    index = np.arange(columns * rows).reshape(rows, columns)
    orders = [index.ravel(), index[::-1, ::-1].ravel(), index[:, ::-1].ravel(), index[::-1].ravel()]
    angles, agreeing = [], []
    for order in orders:
        _, angle, seen = _homography(readings.ordered(order), reference)
        angles.append(float(np.median(angle[seen])))
        agreeing.append(int((angle[seen] < MOST_ANGLE).sum()))
    best = int(np.argmin(angles))
    if angles[best] > MOST_ANGLE:
        raise CalibrationError(f"the patches have not the colours of the chart: half of them are off by {angles[best]:.0f} degrees or "
                               "more: check --chart, --corners, --reflectances and that the light is white")
    return orders[best], np.array([[0, 1, 2, 3], [2, 3, 0, 1], [1, 0, 3, 2], [3, 2, 1, 0]])[best], agreeing[best]


def solve_colors(readings: PatchReadings, chart: ChartReference, xyz_from_rgb: np.ndarray, earlier: np.ndarray) -> ChartColors:
    """Return the matrix from the readings of a chart in their order to a working space.
    `xyz_from_rgb`: [3, 3] from the working space to XYZ under D50. `earlier`: [3, 3] the matrix that the capture had. Raises
    CalibrationError if the response is far from linear, the light is uneven, or too few patches are left; says which."""
    reference = chart.xyz @ np.linalg.inv(xyz_from_rgb).T
    light, gamma, error, refused = _judge(readings, reference, chart)
    used = np.array([index not in refused for index in range(len(reference))])
    value, grey = readings.value[used] / light[used, None], _greys(chart)[used]
    wanted, wanted_lab = reference[used], chart.lab[used]
    weight = 1 / (0.02 + chart.xyz[used, 1:2])
    start = np.linalg.lstsq(value * weight, wanted * weight, rcond=None)[0].T
    size = np.abs(start).max()

    def misfit(matrix: np.ndarray) -> np.ndarray:
        return (lab_from_xyz(value @ (size * matrix.reshape(3, 3)).T @ xyz_from_rgb.T, WHITES["D50"]) - wanted_lab).ravel()

    matrix = size * least_squares(misfit, start.ravel() / size).x.reshape(3, 3)
    neutral = value[grey] if grey.any() else value
    mean = neutral.mean(axis=0)
    scale = float((neutral @ matrix.T)[:, 1].mean() / mean[1])
    all_even = np.where(np.isfinite(readings.value), readings.value, 0) / light[:, None]
    corrected, measured = all_even @ matrix.T, all_even @ earlier.T
    measured *= chart.xyz[used, 1].sum() / max((measured[used] @ xyz_from_rgb[1]).sum(), 1e-30)
    before, after = (np.where(used, delta_e_2000(lab_from_xyz(each @ xyz_from_rgb.T, WHITES["D50"]), chart.lab), np.nan)
                     for each in (measured, corrected))
    findings = []
    if gamma is not None and abs(gamma - 1) > GAMMA_NOTED + 2 * error:
        findings.append(f"response: the greys follow the power {gamma:.2f} of their reflectance, which a linear response does not: check "
                        "color_space, and dark for flare and black level")
    if grey.sum() < LEAST_GREYS:
        findings.append(f"response: {grey.sum()} grey patches are left: whether the response is linear is not checked")
    if light.min() * FALL_NOTED < 1:
        findings.append(f"light: it falls to {100 * light.min():.0f} % over the chart, which is divided out as a plane: light it evenly")
    if np.nanmean(after) > MISFIT_NOTED:
        findings.append(f"colours: the matrix leaves {np.nanmean(after):.1f} in CIEDE2000 on average: check the exposure, and that the "
                        "reference is that of this chart")
    return ChartColors(matrix / scale, mean[1] / mean, light, gamma, refused, measured, corrected, before, after, tuple(findings))


def _greys(chart: ChartReference) -> np.ndarray:
    return np.asarray(np.hypot(chart.lab[:, 1], chart.lab[:, 2]) < NEUTRAL_CHROMA)


def _homography(readings: PatchReadings, reference: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the matrix [3, 3] from chromaticities to those of the reference, the angles [patches] that it leaves, and which are seen."""
    level = np.where(np.isfinite(readings.value).all(axis=1), readings.value.sum(axis=1), 0)
    seen = level > SIGMAS * readings.sigma
    if seen.sum() < 6:
        raise CalibrationError(f"{seen.sum()} of {len(seen)} patches of the chart are lit and not clipped: check the exposure")
    gains = reference[seen].sum(axis=0) / np.maximum(readings.value[seen].sum(axis=0), 1e-30)
    given = readings.value[seen] / level[seen, None] * gains
    wanted = reference[seen] / np.linalg.norm(reference[seen], axis=1, keepdims=True)
    weight = 1 / (0.02 + 3 * readings.sigma[seen] / level[seen])
    values = np.linalg.svd(readings.value[seen] / level[seen, None] * weight[:, None], compute_uv=False)
    if values[2] < LEAST_COLOURS * values[0]:
        raise CalibrationError("the patches differ in fewer than three colours: a matrix needs light with red, green and blue in it")
    angle = np.ones(len(given))
    for _ in range(6):
        trust = weight / (1 + (angle / max(float(np.median(angle)), 0.5)) ** 2)
        equations = np.einsum("p,pij,pk->pijk", trust, _cross(wanted), given)
        matrix = np.linalg.svd(equations.reshape(-1, 9))[2][-1].reshape(3, 3)
        through = given @ matrix.T
        matrix = matrix if (through * wanted).sum() > 0 else -matrix
        through = given @ matrix.T
        angle = np.degrees(np.arccos(np.clip((through * wanted).sum(axis=1) / np.linalg.norm(through, axis=1), -1, 1)))
    everywhere = np.full(len(reference), np.nan)
    everywhere[seen] = angle
    return matrix * gains, everywhere, seen


def _cross(vector: np.ndarray) -> np.ndarray:
    """Return the matrices [n, 3, 3] of the cross product with vectors [n, 3]."""
    x, y, z = vector.T
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)


def _judge(readings: PatchReadings, reference: np.ndarray, chart: ChartReference) -> tuple[np.ndarray, float | None, float, dict[int, str]]:
    """Return the light on each patch as it falls over the chart, the exponent of the response with its standard error, and the patches that
    are left out."""
    matrix, _, seen = _homography(readings, reference)
    through = readings.value @ matrix.T
    shading = np.full(len(reference), np.nan)
    shading[seen] = (through[seen] * reference[seen]).sum(axis=1) / (reference[seen] ** 2).sum(axis=1)
    seen = seen & (np.where(seen, shading, 0) > 0)
    columns, rows = chart.grid
    index = np.arange(len(reference))
    x, y = (index % columns) / (columns - 1) - 0.5, (index // columns) / (rows - 1) - 0.5
    depth = np.log(chart.xyz[:, 1])
    terms = np.stack([np.ones(len(index)), x, y, depth - depth.mean()], axis=1)
    noise = np.where(seen, 3 * readings.sigma / np.maximum(np.where(seen, readings.value.sum(axis=1), 1), 1e-30), 0)
    tolerance = OFF + SIGMAS * noise
    logs = np.log(np.where(seen, shading, 1))

    def misfit(plane: np.ndarray) -> np.ndarray:
        return ((terms @ plane - logs) / tolerance)[seen]

    plane = least_squares(misfit, [float(np.median(logs[seen])), 0, 0, 0], loss="cauchy", f_scale=0.2).x
    off = logs - terms @ plane
    refused = dict(readings.refused)
    refused |= {int(each): "too dark" for each in np.flatnonzero(~seen) if int(each) not in refused}
    brightest = int(np.where(seen, readings.value.sum(axis=1), 0).argmax())  # a reading that nothing exceeds may be cut off
    refused |= {int(each): "glaring" if off[each] > 0 else "clipped or shadowed" if each == brightest else "shadowed"
                for each in np.flatnonzero(seen & (np.abs(off) > tolerance))}
    fall = np.exp(terms[:, 1:3] @ plane[1:3])
    left, needed = len(index) - len(refused), int(np.ceil(LEAST_PART * len(index)))
    if left < needed:
        named = ", ".join(f"{chart.labels()[each]} is {refused[each]}" for each in sorted(refused)[:NAMED]) + ", …" * (len(refused) > NAMED)
        clipped = sum(why == "clipped" for why in refused.values())
        advice = "shorten the exposure" if 2 * clipped > len(refused) else "part of the chart lies in shadow or gloss: light it evenly"
        raise CalibrationError(f"{left} of {len(index)} patches of the chart can be used, {needed} are needed: {advice} ({named})")
    if fall.max() > MOST_FALL * fall.min():
        raise CalibrationError(f"the light falls to {100 * fall.min() / fall.max():.0f} % over the chart: part of it lies in shadow, or a "
                               "lamp is near: light it evenly")
    edge = _edge(terms, logs, tolerance, seen)
    if edge < HALF_SHADOW:
        raise CalibrationError(f"the light on one half of the chart is {100 * edge:.0f} % of that on the other, with an edge between them: "
                               "half of it lies in shadow: light it evenly")
    slope, error = _response(logs - np.log(fall), depth, _greys(chart) & np.array([each not in refused for each in index]))
    bent = float(plane[3]) if slope is None else slope
    if abs(bent) > GAMMA_REFUSED + SIGMAS * error:
        raise CalibrationError(f"the greys of the chart follow the power {1 + bent:.2f} of their reflectance: the response is not linear: "
                               "give the images their color_space")
    return fall / fall.max(), None if slope is None else 1 + slope, error, refused


def _edge(terms: np.ndarray, logs: np.ndarray, tolerance: np.ndarray, seen: np.ndarray) -> float:
    """Return the light on the darker half of the chart over that on the other, 0 to 1, where an edge through its middle and an even fall
    fit the logarithms of the light on the patches best."""
    best, step = np.inf, 0.0
    for turn in np.pi * np.arange(DIRECTIONS) / DIRECTIONS:
        both = np.column_stack([terms, np.sign(np.round(terms[:, 1] * np.cos(turn) + terms[:, 2] * np.sin(turn), 9)) / 2])

        def misfit(fit: np.ndarray, both: np.ndarray = both) -> np.ndarray:
            return ((both @ fit - logs) / tolerance)[seen]

        found = least_squares(misfit, [float(np.median(logs[seen])), 0, 0, 0, 0], loss="cauchy", f_scale=0.2)
        if found.cost < best:
            best, step = found.cost, abs(float(found.x[4]))
    return float(np.exp(-step))


def _response(logs: np.ndarray, depth: np.ndarray, grey: np.ndarray) -> tuple[float | None, float]:
    """Return the slope of the logarithm of the light over that of reflectance on grey patches, and its standard error."""
    if grey.sum() < LEAST_GREYS:
        return None, 0.0
    x = depth[grey] - depth[grey].mean()
    slope = float(x @ logs[grey] / (x @ x))
    left = logs[grey] - logs[grey].mean() - slope * x
    return slope, float(np.sqrt(left @ left / max(len(x) - 2, 1) / (x @ x)))
