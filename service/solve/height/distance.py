"""The place of the surface along the view axis, where the manifest does not give it, from images under near lights.

The brightness of a point under a near light falls with the square of its distance, so that the images of several lights fit together
only where the surface is as far away as it was. Depths are tried from very near to far against the place of the lights: on the plane at
each depth normals are fitted to a sample of the pixels, integrated, and fitted again on the surface that results; what the readings leave
about Lambert's law decides. Depths are those below the camera, or for an orthographic camera, which has no place on the axis, those
below the light that is nearest to it.

Source: the dependence of photometric stereo under near lights on the mean distance, Quéau, Durix, Wu, Cremers, Lauze and Durou,
"LED-based photometric stereo: modeling, calibration and numerical solution", J. Math. Imaging Vis. 60, 2018, section 2.
"""

from typing import Any, NamedTuple

import numpy as np

from kernels.device import to_numpy
from kernels.surface.integrate import IntegrationOptions, integrate_normals
from service.light_estimation.lambertian import CAUCHY, LEAST_SPREAD, SHADOW, bright_readings, degrees_between, median_of
from stage.capture.camera import Camera
from stage.capture.capture import Capture
from stage.capture.light import PointLight
from stage.capture.manifest import FILE_NAME
from stage.capture.point_lights import LightPlaces, PlacedLights, light_places
from stage.colour.colour import GREY_WEIGHTS
from stage.errors import ManifestError
from stage.spread import MAD_TO_SIGMA
from stage.stack.stack import Stack

ACROSS = 32
"""Samples along the longer side of the object."""
NEAREST, FARTHEST = 0.03, 8.0
"""Depths that are tried, over the largest distance between two lights: lights farther away than this are as good as distant."""
TRIALS, CLOSER = 100, 9
"""Depths of the first series, evenly in the logarithm, 6 % apart, because lights close to the surface fit over some per cent alone; and of
each of two series about the best of the one before."""
ROUNDS = 3
"""Fits at each depth, each on the surface that the normals of the last one make; the residual changes by less than a tenth after three."""
INTEGRATION = IntegrationOptions(tolerance=1e-3)
"""Depths and their standard errors are the same to five digits as with a thousandth of this tolerance."""
NOISE = 0.02
"""Residual, relative to the bright readings of a pixel, from which the cost of a reading grows only with its logarithm."""
LEAST_LIT = 4
"""Least count of lit readings of a pixel that is judged: three fit any depth."""
LEAST_PIXELS = 60
APART = 1.3
"""The depth must explain the images better than one this many times nearer, and one this many times farther."""
SURE = 2.5
"""Least ratio of that difference to its standard error over squares of pixels."""
SQUARES = 4
"""Squares along a side of the object: their costs show how sure the depth is."""
LARGEST_SIGMA = 0.15
"""Largest standard error, relative to the depth, with which a capture is solved."""
MODEL_SIGMA, RISE = (0.004, 0.008, 0.015, 0.03), 0.3
"""Standard error beside those of left-out squares and lights, for shapes that the fit on a coarse grid does not follow: the first of these
that makes the cost grow by so much, or the last."""
GROUPS = 8
"""Groups of lights, each of which is left out once: errors of their places and intensities are alike in all pixels."""
LEAST_LIGHTS = 5
"""The fewest lights: one can then be left out, and a reading to spare remains."""
AROUND = 0.5
"""Depths that are tried without a group of lights, on either side of the best in the logarithm."""
FIT_ROUNDS = 3
"""Rounds of re-weighting of a fit."""
LARGEST_RESIDUAL = 1e6
"""Residuals are cut here: where all lights are in one line of sight, normals that cannot be found leave anything."""


class NotTold(ManifestError):
    """The images do not tell how far the surface is."""


class Distance(NamedTuple):
    """The depth that explains the images, and what the report says of it."""

    capture: Capture
    """The capture with `surface_z_m`; without it where an orthographic camera keeps its default."""
    facts: dict[str, Any]
    warning: str
    normal_degrees: float
    """Standard error of the normals for that of the depth."""


class Lamps(NamedTuple):
    """Lights as `stage.capture.point_lights.PlacedLights` has them, of one strength for all channels."""

    place: np.ndarray  # [lights, 4] metres and 1, or unit direction and 0
    strength: np.ndarray  # [lights] intensity, or irradiance
    lobe: np.ndarray  # [lights, 4] axis and exponent


class NearFit(NamedTuple):
    """The normals of pixels, and what they leave."""

    normal: np.ndarray  # [3, pixels] float64, unit
    residual: np.ndarray  # [lights, pixels] float64, over the bright readings of the pixel; 0 where not lit
    lit: np.ndarray  # [lights, pixels] bool: readings that are compared, the same wherever the points are


class NearSample(NamedTuple):
    """Pixels on a grid over an object, and what is known of them."""

    row: np.ndarray  # [rows] int, rows of the image
    col: np.ndarray  # [cols] int
    mask: np.ndarray  # [rows, cols] bool
    x: np.ndarray  # [rows, cols] slopes of the lines of sight
    y: np.ndarray
    readings: np.ndarray  # [lights, pixels of the mask]
    usable: np.ndarray
    lamps: Lamps
    perspective: bool
    top: float
    """The z from which depths count: 0, or that of the light nearest to an orthographic camera."""

    def pixels(self, width: int) -> np.ndarray:
        """Return the numbers of the pixels of the mask in an image of this width, [pixels]."""
        return np.asarray((self.row[:, None] * width + self.col)[self.mask])

    def points(self, height: np.ndarray) -> np.ndarray:
        """Return the points of the pixels at these z, [rows, cols, 3] metres."""
        along = -height if self.perspective else 1.0
        return np.stack([self.x * along, self.y * along, height], axis=-1)

    def sight(self) -> np.ndarray:
        """Return the directions towards the camera, [3, rows, cols]."""
        leaning = 1.0 if self.perspective else 0.0
        return np.stack([-leaning * self.x, -leaning * self.y, np.ones_like(self.x)])


def find_distance(capture: Capture, stack: Stack, device: str) -> Distance:
    """Return a capture with the depth of the surface that its images tell; an orthographic camera whose images do not keeps z = 0.
    Raises ManifestError: the images of a perspective camera do not tell the depth, or the lights are not usable."""
    try:
        return _found(capture, stack, device)
    except NotTold as error:
        if capture.camera.projection == "perspective":
            raise
        return Distance(capture, {}, f"{error}; 0 was taken, the default of an orthographic camera: heights, normals and albedo are wrong "
                        "if the surface is elsewhere", 0.0)


def _found(capture: Capture, stack: Stack, device: str) -> Distance:
    where = f"{capture.folder / FILE_NAME}: camera.surface_z_m: is missing, and the images"
    if stack.light_count < LEAST_LIGHTS:
        raise NotTold(f"{where} of {stack.light_count} lights do not tell it ({LEAST_LIGHTS} or more do): measure the mean z of the "
                            "object in the camera frame")
    span = _span(capture)
    if span <= 0:
        raise NotTold(f"{where} do not tell it, because all near lights are in one place: measure the mean z of the object in the camera "
                      "frame")
    depths = np.geomspace(NEAREST * span, FARTHEST * span, TRIALS)
    costs: dict[float, np.ndarray] = {}
    sample = near_sample(capture.camera, capture.mask(), stack, light_places(capture))
    usable = sample.usable.sum(axis=0) >= LEAST_LIT
    if usable.sum() < LEAST_PIXELS:
        raise NotTold(f"{where} do not tell it: {int(usable.sum())} of the pixels that were looked at have {LEAST_LIT} "
                            "readings: measure the mean z of the object in the camera frame")
    step = float(np.log(depths[1] / depths[0]))
    best = float(depths[0])
    for _ in range(3):
        for depth in (float(f"{depth:.9g}") for depth in depths):  # the middle of a series is that of the series before
            if depth not in costs:
                costs[depth] = _cost(sample, depth, device)
        totals = {depth: cost.mean() for depth, cost in costs.items()}
        best = min(totals, key=lambda depth: totals[depth])
        depths = best * np.exp(np.linspace(-step, step, CLOSER))
        step = 2 * step / (CLOSER - 1)
    tried = np.array(sorted(costs))
    table = np.array([costs[depth] for depth in tried])
    place = int(np.argmin(table.mean(axis=1)))
    if best < NEAREST * span * APART or best > FARTHEST * span / APART:
        raise NotTold(f"{where} do not tell it: they fit best at {sample.top - best:.3g} m, at the {'near' if best < span else 'far'} end "
                      "of what was tried: check positions and intensities of the lights, or measure the mean z of the object")
    square = squares_of(sample.mask)
    chosen = [number for number in np.unique(square) if (square == number).any()]
    logarithm = _lowest(tried, table.mean(axis=1))
    others = np.array([_lowest(tried, table[:, square != number].mean(axis=1)) for number in chosen])
    count = len(chosen)
    model = next((part for part in MODEL_SIGMA[:-1] if sum(_cost(sample, best * factor, device).mean() for factor in (1 - part, 1 + part))
                  > 2 * (table[place].mean() + RISE)), MODEL_SIGMA[-1])
    of_places = (count - 1) / count * ((others - logarithm) ** 2).sum()
    sigma = float(np.sqrt(of_places + _spread_by_lights(sample, best, device) + model**2))
    worst = np.inf
    for factor in (APART, 1 / APART):
        more = _cost(sample, best * factor, device) - table[place]
        of_squares = np.array([more[square == number].sum() for number in chosen])
        worst = min(worst, float(of_squares.sum() / max(np.sqrt((of_squares**2).sum()), 1e-12)))
    depth = float(np.exp(logarithm))
    if worst < SURE or sigma > LARGEST_SIGMA:
        raise NotTold(f"{where} hardly tell it: {sample.top - depth:.3g} m explains them best, with a standard error of "
                            f"{100 * sigma:.0f} % of the depth or more: measure the mean z of the object in the camera frame")
    sigma_m = sigma * depth
    here, off = (surface_at(sample, depth * factor, device).normal for factor in (1.0, 1.0 + sigma))
    turned = float(np.median(degrees_between(here, off)))
    z = sample.top - depth
    facts = {"surface_z_m": float(f"{z:.6g}"), "sigma_m": float(f"{sigma_m:.3g}"),
             "sigma_of_normals_degrees": round(turned, 3)}
    return Distance(capture.at_distance(z), {"distance": facts}, (
        f"camera.surface_z_m: is missing, and was taken as {z:.4g} m ± {sigma_m:.2g} m, which explains the images best: heights "
        "and albedo have this error in common; write a measured one into capture.json where there is one"), turned)


def _span(capture: Capture) -> float:
    """Return the largest distance between two of the near lights, metres."""
    places = np.array([light.position_m for _, light in capture.lit_by(PointLight)])
    return float(np.linalg.norm(places[:, None] - places, axis=2).max())


def near_sample(camera: Camera, mask: np.ndarray, stack: Stack, placed: LightPlaces | PlacedLights) -> NearSample:
    """Return pixels that are evenly spread over the object, with the lights of the stack. `mask`: [rows, cols] bool, the object."""
    rows, cols = np.nonzero(mask)
    step = max(1, int(np.ceil((max(np.ptp(rows), np.ptp(cols)) + 1) / ACROSS)))
    row, col = np.mgrid[rows.min():rows.max() + 1:step, cols.min():cols.max() + 1:step]
    inside = mask[row, col]
    x, y = camera.plane_at(col + 0.5, row + 0.5)
    radiance, usable = stack.pick_radiance((row * camera.width + col)[inside])
    readings = np.einsum("lpc,c->lp", radiance.astype(np.float64), np.asarray(GREY_WEIGHTS))
    perspective = camera.projection == "perspective"
    top = 0.0 if perspective else float(placed.place[placed.place[:, 3] == 1, 2].max())
    lamps = Lamps(placed.place, placed.strength @ np.asarray(GREY_WEIGHTS), placed.lobe)
    return NearSample(row[:, 0], col[0], inside, x, y, readings, usable, lamps, perspective, top)


def _cost(sample: NearSample, depth: float, device: str) -> np.ndarray:
    """Return the cost of each pixel, [pixels], of a surface with this mean depth."""
    return cost_of(surface_at(sample, depth, device))


def cost_of(fit: NearFit, *, least_lit: int = LEAST_LIT, unlit: float = float(np.log1p(1 / NOISE**2))) -> np.ndarray:
    """Return the cost of each pixel, [pixels]: the mean over its lit readings of ln(1 + (residual / noise)²), or `unlit` where fewer than
    `least_lit` are lit."""
    lit = fit.lit.sum(axis=0)
    cost = np.where(fit.lit, np.log1p((fit.residual / NOISE) ** 2), 0).sum(axis=0) / np.maximum(lit, 1)
    return np.where(lit >= least_lit, cost, unlit)


def surface_at(sample: NearSample, depth: float, device: str) -> NearFit:
    """Return the normals of a surface with this mean depth, and what they leave."""
    mask, z, sight = sample.mask, sample.top - depth, sample.sight()
    fit = fit_near(sample.readings, sample.usable, sample.lamps, sample.points(np.full(mask.shape, z))[mask])
    for _ in range(ROUNDS - 1):
        normal = np.zeros((3, *mask.shape), np.float32)
        normal[:, mask] = fit.normal
        solved = mask & ((normal * sight).sum(axis=0) > 0.05 * np.linalg.norm(sight, axis=0))
        if not solved.any():
            break
        found = to_numpy(integrate_normals(normal, solved, sample.x.astype(np.float32), sample.y.astype(np.float32),
                                  perspective=sample.perspective, mean_z=z, options=INTEGRATION,
                                  device=device).height)
        height = np.where(solved & np.isfinite(found) & (found < sample.top), found, z)
        fit = fit_near(sample.readings, sample.usable, sample.lamps, sample.points(height)[mask])
    return fit


def _spread_by_lights(sample: NearSample, best: float, device: str) -> float:
    """Return the variance of the logarithm of the depth for the errors of the lights, by leaving out groups of them."""
    count = len(sample.readings)
    groups = np.arange(count) % min(GROUPS, count)
    depths = best * np.exp(np.linspace(-AROUND, AROUND, CLOSER))
    found = []
    for group in np.unique(groups):
        kept = groups != group
        lamps = Lamps(*(values[kept] for values in sample.lamps))
        part = sample._replace(readings=sample.readings[kept], usable=sample.usable[kept], lamps=lamps)
        found.append(_lowest(depths, np.array([_cost(part, depth, device).mean() for depth in depths])))
    return float((len(found) - 1) / len(found) * ((np.array(found) - np.mean(found)) ** 2).sum())


def squares_of(mask: np.ndarray) -> np.ndarray:
    """Return the number of the square that each pixel of a mask lies in, [pixels]."""
    row, col = np.nonzero(mask)
    return np.asarray(row * SQUARES // mask.shape[0] * SQUARES + col * SQUARES // mask.shape[1])


def _lowest(depths: np.ndarray, cost: np.ndarray) -> float:
    """Return the logarithm of the depth at which costs are lowest, by the parabola through the lowest three."""
    at = int(np.clip(np.argmin(cost), 1, len(depths) - 2))
    x, y = np.log(depths[at - 1:at + 2]), cost[at - 1:at + 2]
    a, b, _ = np.polyfit(x - x[1], y, 2)
    return float(x[1] + (np.clip(-b / (2 * a), x[0] - x[1], x[2] - x[1]) if a > 0 else 0.0))


def fit_near(readings: np.ndarray, usable: np.ndarray, lamps: Lamps, points: np.ndarray) -> NearFit:
    """Fit E b·l robustly to the readings of each pixel, where E is the irradiance that each light has at its point [pixels, 3].

    What the fit leaves is relative to the bright readings of the pixel, which do not depend on where the point is thought to be, so that
    places can be compared by it.
    """
    way = lamps.place[:, :3] - lamps.place[:, 3:] * points[:, None]  # [pixels, lights, 3]
    distance = np.maximum(np.linalg.norm(way, axis=2), 1e-12)
    direction = way / distance[..., None]
    irradiance = lamps.strength / np.where(lamps.place[:, 3] == 1, distance**2, 1.0)
    if lamps.lobe.any():
        irradiance *= np.maximum(-(direction * lamps.lobe[:, :3]).sum(axis=2), 0) ** lamps.lobe[:, 3]
    # one factor a pixel: only the ratios of the lights count
    lit_by = direction * (irradiance / np.maximum(irradiance.mean(axis=1, keepdims=True), 1e-300))[..., None]
    bright = np.broadcast_to(bright_readings(readings, usable), readings.shape)
    relative = np.divide(readings, bright, out=np.zeros_like(readings), where=bright > 0)
    lit = usable & (relative > SHADOW)
    weight = lit.astype(np.float64)
    for _ in range(FIT_ROUNDS):
        weighted = (lit_by * weight.T[..., None]).transpose(0, 2, 1)
        gram = weighted @ lit_by
        gram += (1e-9 * np.trace(gram, axis1=1, axis2=2) + 1e-200)[:, None, None] * np.eye(3)
        vector = np.linalg.solve(gram, weighted @ relative.T[..., None])
        residual = np.where(lit, np.clip(relative - (lit_by @ vector)[..., 0].T, -LARGEST_RESIDUAL, LARGEST_RESIDUAL), 0)
        spread = MAD_TO_SIGMA * median_of(np.abs(residual), lit) + LEAST_SPREAD
        weight = lit / (1 + (residual / (CAUCHY * spread)) ** 2)
    return NearFit((vector / np.maximum(np.linalg.norm(vector, axis=1, keepdims=True), 1e-300))[..., 0].T, residual, lit)
