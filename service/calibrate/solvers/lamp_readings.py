"""The irradiance that one lamp gives at a ball or a card, one linear reading for each channel of each image, and what readings at several
drives say of a primary of the lamp: its colour, its irradiance at full level and its response.

A grey ball or card follows Lambert's law, reading = ρ/π E max(0, n·l). A mirror ball shows the lamp, and E is the integral of its
radiance over solid angle. The pixels and their weights are chosen once for a lamp, in its brightest image, so that readings are linear in
its light however dark it is.

The model is reading = E g(drive), with one colour E for all drives and a response g that rises from 0 to 1: the light at each drive is the
least-squares factor of E, the response their isotonic regression. Between the drives that were measured it follows the nearest
((d - d₀)/(1 - d₀))^γ, d₀ the end of a dead band, corrected to pass through all of them.

Source: as service/light_estimation/grey_ball.py; for the mirror ball Debevec, "Rendering synthetic objects into real scenes", SIGGRAPH
    1998; isotonic regression by pool adjacent violators, Ayer et al., Annals of Mathematical Statistics 26(4), 1955.
"""

from typing import NamedTuple

import numpy as np
from scipy.optimize import isotonic_regression, least_squares

from service.calibrate.solvers.chart_patches import ChartPatches
from service.calibrate.solvers.mirror_ball import find_spot
from service.light_estimation.ball import Ball, BallView
from service.light_estimation.grey_ball import MIN_COSINE, MIN_FACING, MIN_PIXELS, WEIGHT_SCALE, fit_direction
from stage.errors import CalibrationError
from stage.spread import MAD_TO_SIGMA

OFF_DEGREES = 20.0
"""The most that the ball may show a lamp from elsewhere than the rig says; a ball that is a little glossy is off by some degrees."""
MOST_MISFIT = 0.25
"""The largest misfit of a Lambertian target; a flat disc taken for a ball leaves 0.3."""
MOST_CLIPPED = 0.01
"""The largest part of the pixels that may be saturated, as highlights of paint are; these are left out."""
SPOT_DEGREES, RING_DEGREES = 20.0, 35.0
"""A lamp is seen in a mirror ball within the first angle of its direction; between the two there is what else the ball shows."""
ROUNDS = 10
"""The iterations of the re-weighted least squares."""
CURVE_POINTS = 33
"""The number of even drives at which a response is written, beside those that were measured."""
LEAST_DRIVES = 3
"""The fewest drives above 0 from which a response is measured."""
LINEAR = 0.002
"""A response that differs less from the straight line, or less than three times its standard error, is linear."""
FALLS = 5.0
"""The light may fall by so many standard errors and LARGE_FALL of full scale from one drive to a higher one."""
LARGE_FALL = 0.02
MOST_GAMMA = 6.0


class Reading(NamedTuple):
    """The light of one image on the target."""

    value: np.ndarray  # [3] float64: ρ/π times the irradiance for grey targets, the reflectance times it for a mirror
    sigma: np.ndarray  # [3] float64: standard error from the scatter of the pixels


class LambertTemplate(NamedTuple):
    """A grey ball or card under a lamp."""

    usable: np.ndarray  # [h, w] bool
    model: np.ndarray  # [pixels, 1 or 3] float64: n·l, of a chart times the reflectance
    weight: np.ndarray  # [pixels, 1] float64, one for all channels: gloss is as bright beside the noise of a faint channel
    misfit: float
    """What the brightest image leaves of the model, relative to it."""

    def read(self, radiance: np.ndarray, saturated: np.ndarray | None) -> Reading:
        """Return the least-squares factor of the model in each channel."""
        _check_clipped(saturated, self.usable)
        weight = self.weight if saturated is None else self.weight * ~saturated[self.usable][:, None]
        readings = radiance[self.usable].astype(np.float64)
        square = (weight * self.model**2).sum(axis=0)
        value = (weight * self.model * readings).sum(axis=0) / square
        spread = ((weight * self.model * (readings - self.model * value)) ** 2).sum(axis=0)
        return Reading(value, np.sqrt(spread) / square)


class MirrorTemplate(NamedTuple):
    """A mirror ball that shows a lamp."""

    spot: np.ndarray  # [h, w] bool
    ring: np.ndarray  # [h, w] bool
    solid: np.ndarray  # [h, w] float64, the solid angle that each pixel reflects, steradians
    misfit: float

    def read(self, radiance: np.ndarray, saturated: np.ndarray | None) -> Reading:
        """Return the integral over the spot, less the median around it."""
        if saturated is not None and saturated[self.spot].any():
            raise CalibrationError(f"{int(saturated[self.spot].sum())} pixels of the lamp's reflection are saturated: shorten the exposure")
        around, solid = radiance[self.ring].astype(np.float64), self.solid[self.spot]
        level = np.median(around, axis=0)
        scatter = MAD_TO_SIGMA * np.median(np.abs(around - level), axis=0)
        value = ((radiance[self.spot] - level) * solid[:, None]).sum(axis=0)
        variance = (solid**2).sum() + solid.sum() ** 2 / max(len(around), 1)
        return Reading(value, scatter * np.sqrt(variance))


def grey_ball_template(radiance: np.ndarray, saturated: np.ndarray | None, direction: np.ndarray, view: BallView) -> LambertTemplate:
    """Choose the pixels of a grey ball under a lamp in this direction.
    Raises CalibrationError if too little of the ball is lit, or it is lit from elsewhere, or is no grey ball."""
    cosine = view.normal @ direction
    usable = view.inside & ((view.normal * view.to_viewer).sum(axis=-1) > MIN_FACING) & (cosine > MIN_COSINE)
    _check_clipped(saturated, usable)
    shading = fit_direction(radiance, saturated, view)
    _check_direction(shading.direction, direction, shading.uncertainty_degrees)
    return _lambert(radiance, saturated, usable, cosine[..., None])


def facing_cosine(direction: np.ndarray, normal: np.ndarray) -> float:
    """Return the cosine between a lamp's direction and the normal of a card.
    Raises CalibrationError if the lamp stands behind the card, or nearly."""
    cosine = float(normal @ direction)
    if cosine < MIN_COSINE:
        raise CalibrationError(f"the lamp stands {np.degrees(np.arccos(np.clip(cosine, -1, 1))):.0f} degrees from the card's normal, and "
                               "lights it at a grazing angle or from behind: turn the card, or use a ball")
    return cosine


def card_template(radiance: np.ndarray, saturated: np.ndarray | None, direction: np.ndarray, normal: np.ndarray,
                  chart: ChartPatches | None = None) -> LambertTemplate:
    """Choose the pixels of a card that faces along `normal`: all of the image, or the neutral patches of a chart."""
    cosine = facing_cosine(direction, normal)
    if chart is None:
        whole = np.ones(radiance.shape[:2], dtype=bool)
        return _lambert(radiance, saturated, whole, np.full((*whole.shape, 1), cosine))
    return _lambert(radiance, saturated, chart.neutral[chart.label], cosine * chart.reflectance[chart.label])


def mirror_ball_template(radiance: np.ndarray, saturated: np.ndarray | None, direction: np.ndarray, ball: Ball,
                         view: BallView) -> MirrorTemplate:
    """Choose the pixels of a mirror ball that show a lamp in this direction."""
    spot = find_spot(radiance, saturated, ball, view)
    _check_direction(spot.direction, direction, spot.uncertainty_degrees)
    facing = (view.normal * view.to_viewer).sum(axis=-1)
    cosine = (2 * facing[..., None] * view.normal - view.to_viewer) @ spot.direction
    # the normals of a pixel's corners span its solid angle; the reflected ones 4 cos θ times as much
    down, across = np.gradient(view.normal, axis=0), np.gradient(view.normal, axis=1)
    solid = 4 * facing * np.linalg.norm(np.cross(across, down), axis=-1)
    inside = view.inside & (facing > MIN_FACING)
    ring = inside & (cosine < np.cos(np.radians(SPOT_DEGREES))) & (cosine > np.cos(np.radians(RING_DEGREES)))
    if not ring.any():
        raise CalibrationError("the reflection of the lamp lies at the rim of the ball: put the camera elsewhere")
    return MirrorTemplate(inside & (cosine >= np.cos(np.radians(SPOT_DEGREES))), ring, solid, 0.0)


def _lambert(radiance: np.ndarray, saturated: np.ndarray | None, usable: np.ndarray, shading: np.ndarray) -> LambertTemplate:
    _check_clipped(saturated, usable)
    usable = usable if saturated is None else usable & ~saturated
    if usable.sum() < MIN_PIXELS:
        raise CalibrationError(f"{int(usable.sum())} pixels of the target are in the light of the lamp: {MIN_PIXELS} are needed")
    model, readings = shading[usable], radiance[usable].astype(np.float64)
    value = np.median(readings / model, axis=0)
    weight = np.ones((len(readings), 1))
    for _ in range(ROUNDS):
        left = (readings - model * value).sum(axis=1, keepdims=True)
        spread = MAD_TO_SIGMA * np.median(np.abs(left))
        floor = 1e-12 * np.abs(readings).max() + 1e-300  # exact readings have no scatter
        weight = 1 / (1 + (left / (WEIGHT_SCALE * spread + floor)) ** 2)
        value = (weight * readings * model).sum(axis=0) / (weight * model**2).sum(axis=0)
    if not value.max() > 0:
        raise CalibrationError("the target is dark in the brightest image of the lamp")
    left = (readings - model * value) / float(value.max())
    misfit = float(np.sqrt((weight * left**2).sum() / (weight * model**2).mean(axis=1).sum()))
    if misfit > MOST_MISFIT:
        raise CalibrationError(f"the shading of the target misses Lambert's law under this lamp by {misfit:.0%}: check that the table "
                               "names the right lamp, that it alone is lit, and the place of the target")
    return LambertTemplate(usable, model, weight, misfit)


def _check_direction(found: np.ndarray, direction: np.ndarray, uncertainty_degrees: float) -> None:
    """Check that the target is lit from where the rig has the lamp."""
    degrees = float(np.degrees(np.arccos(np.clip(found @ direction, -1, 1))))
    if degrees > OFF_DEGREES + 2 * uncertainty_degrees:
        raise CalibrationError(f"the ball is lit from {degrees:.0f} degrees away of where the rig has the lamp: check that the table names "
                               "the right lamp, and the lamp's direction in the rig")


def _check_clipped(saturated: np.ndarray | None, usable: np.ndarray) -> None:
    clipped, whole = 0 if saturated is None else int((saturated & usable).sum()), int(usable.sum())
    if clipped > MOST_CLIPPED * whole:
        raise CalibrationError(f"{clipped} of {whole} pixels of the target in the lamp's light are saturated: shorten the exposure")


class MeasuredPrimary(NamedTuple):
    """One primary of a lamp."""

    irradiance: np.ndarray  # [3] float64, 0 or more, in the unit of the readings
    sigma: np.ndarray  # [3] float64: its standard error
    response: tuple[tuple[float, float], ...] | None
    """Pairs of drive and light from (0, 0) to (1, 1); None: linear within its error, or too few drives were measured."""
    drives: int
    """The number of different drives."""
    residual: float
    """Root mean square of reading − E g over all readings, relative to the brightest."""
    response_sigma: float
    """The largest standard error of a point of the response; 0 without one."""


def fit_primary(
    drive: np.ndarray,  # [n] above 0 to 1, with 1 among them; several readings may have one drive
    value: np.ndarray,  # [n, 3] readings, linear
    sigma: np.ndarray,  # [n, 3] their standard errors
) -> MeasuredPrimary:
    """Fit a primary to its readings. Raises CalibrationError if there is no reading at full level, or light falls while the drive rises."""
    if not (drive == 1).any():
        raise CalibrationError("no image shows it at full level: its irradiance at full level is not known")
    drives, place = np.unique(drive, return_inverse=True)
    full = value[drive == 1].mean(axis=0)
    if not full.max() > 3 * sigma[drive == 1].mean(axis=0)[full.argmax()]:
        raise CalibrationError("it is dark at full level")
    colour, light = full, np.ones(len(value))
    weight = 1 / np.maximum(sigma, 1e-6 * full.max()) ** 2
    for _ in range(3):  # alternating least squares of a matrix of rank one, which begins beside its solution
        light = (weight * value * colour).sum(axis=1) / (weight * colour**2).sum(axis=1)
        colour = (weight * value * light[:, None]).sum(axis=0) / (weight * light[:, None] ** 2).sum(axis=0)
    light_sigma = 1 / np.sqrt((weight * colour**2).sum(axis=1))
    precision = np.bincount(place, 1 / light_sigma**2)
    mean = np.bincount(place, light / light_sigma**2) / precision
    error = 1 / np.sqrt(precision)
    top = mean[-1]
    fall = np.maximum.accumulate(mean) - mean
    if (fall > FALLS * error + LARGE_FALL * top).any():
        worst = int((fall - FALLS * error).argmax())
        raise CalibrationError(f"it is darker at the level {drives[worst]:.3g} than at a lower one: check the table, and whether the lamp "
                               "had settled when the image was taken")
    residual = float(np.sqrt(((value - light[:, None] * colour) ** 2).mean()) / full.max())
    repeated = _repeatability(light / top, place)
    scale = np.maximum(top * colour, 0.0)
    scale_sigma = np.hypot(sigma[drive == 1].mean(axis=0) / np.sqrt((drive == 1).sum()), np.hypot(residual, repeated) * full.max())
    response, response_sigma = None, 0.0
    if len(drives) >= LEAST_DRIVES:
        points = np.clip(isotonic_regression(mean / top, weights=precision).x, 0, 1)
        points[-1] = 1.0
        response_sigma = float(np.hypot(error / top, repeated).max())
        if (np.abs(points - drives) > np.maximum(LINEAR, 3 * np.hypot(error / top, repeated))).any():
            response = _curve(drives, points)
    return MeasuredPrimary(scale, scale_sigma, response, len(drives), residual, response_sigma)


def _repeatability(light: np.ndarray, place: np.ndarray) -> float:
    """Return the standard deviation of readings at one drive about their mean; 0 where none was repeated."""
    count = np.bincount(place)
    left = light - (np.bincount(place, light) / count)[place]
    free = len(light) - len(count)
    return float(np.sqrt((left**2).sum() / free)) if free else 0.0


def _curve(drives: np.ndarray, points: np.ndarray) -> tuple[tuple[float, float], ...]:
    """Return a response through measured points, which begins at (0, 0)."""
    def model(form: np.ndarray, drive: np.ndarray) -> np.ndarray:
        dead, gamma = form
        return np.asarray(np.clip((drive - dead) / (1 - dead), 0, 1) ** gamma)

    dark = float(drives[points <= 0].max(initial=0.0))
    starts = [(dark + part * (float(drives[points > 0].min()) - dark), gamma) for part in (0.0, 0.5, 0.9) for gamma in (1.0, 2.0, 0.5)]
    fits = [least_squares(lambda form: model(form, drives) - points, start, bounds=([0, 0.1], [0.95, MOST_GAMMA])) for start in starts]
    form = min(fits, key=lambda fit: float(fit.cost)).x
    known, light = np.append(0.0, drives), np.append(0.0, points)
    grid = np.unique(np.concatenate([np.linspace(0, 1, CURVE_POINTS), drives, form[:1].round(5)]))
    curve = model(form, grid) + np.interp(grid, known, light - model(form, known))
    curve = np.clip(np.maximum.accumulate(curve), 0, 1)
    curve[0], curve[-1] = 0.0, 1.0
    return tuple((float(f"{drive:.6g}"), float(f"{value:.6g}")) for drive, value in zip(grid, curve, strict=True))
