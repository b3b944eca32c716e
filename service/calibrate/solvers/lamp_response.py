"""The colour, the irradiance at full level and the response of one primary of a lamp, from readings at several drives.

The model is reading = E g(drive), with one colour E for all drives and a response g that rises from 0 to 1: the light at each drive is the
least-squares factor of E, the response their isotonic regression. Between the drives that were measured it follows the nearest
((d - d₀)/(1 - d₀))^γ, d₀ the end of a dead band, corrected to pass through all of them.

Source: isotonic regression by pool adjacent violators, Ayer et al., Annals of Mathematical Statistics 26(4), 1955.
"""

from typing import NamedTuple

import numpy as np
from scipy.optimize import isotonic_regression, least_squares

from stage.errors import CalibrationError

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


def fit_primary(drive: np.ndarray, value: np.ndarray, sigma: np.ndarray) -> MeasuredPrimary:
    """Fit a primary to its readings.

    Args:
        drive: [n] above 0 to 1, with 1 among them; several readings may have one drive.
        value: [n, 3] readings, linear.
        sigma: [n, 3] their standard errors.

    Raises:
        CalibrationError: there is no reading at full level, or light falls while the drive rises.
    """
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
