"""Slow float64 twins of the photometric solvers, one pixel at a time, from the papers; they import nothing of ours.

Woodham 1980 (least squares of b·l), Shi et al. 2014 section 5 (the middle brightness ranks), Huber and Ronchetti 2009
chapter 7 (Cauchy weights). Readings are [light, pixel], directions [light, 3]; a reading of 0 is no reading.
"""

from typing import NamedTuple

import numpy as np


class Fit(NamedTuple):
    normal: np.ndarray  # [pixel, 3]
    residual: np.ndarray  # [pixel]
    across: np.ndarray  # [pixel]
    squares: np.ndarray  # [pixel]
    freedom: np.ndarray  # [pixel]
    spare: np.ndarray  # [pixel]
    agreeing: np.ndarray  # [pixel]
    status: np.ndarray  # [pixel] names
    weights: np.ndarray  # [light, pixel]


NOTHING = (np.zeros(3), 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def grey_readings(radiance, irradiance, grey_weights, saturated=None):
    """Σ_c w_c radiance_c / E_c over the channels that every light has; 0 where that is not a measurement.

    Args:
        radiance: [3, light, pixel].
        irradiance: [light, 3].
        grey_weights: of the channels; what is left of them is made to add up to one.
        saturated: [light, pixel] bool.
    """
    usable = [c for c in range(3) if (irradiance[:, c] > 0).all() and grey_weights[c] > 0]
    total = sum(grey_weights[c] for c in usable)
    with np.errstate(invalid="ignore"):
        grey = sum(grey_weights[c] / total * radiance[c] / irradiance[:, c, None] for c in usable)
    measured = np.isfinite(grey) & (np.nan_to_num(grey) > 0)
    if saturated is not None:
        measured &= ~saturated
    return np.where(measured, grey, 0.0)


def fit_weighted(readings, directions, weights):
    """b of min Σ w (y - b·l)² over one pixel, and the spread Σ w l lᵀ; or the name of why there is none."""
    if (weights > 0).sum() < 3:
        return None, None, "TOO_FEW_LIGHTS" if (weights > 0).any() else "DARK"
    spread = np.einsum("l,li,lj->ij", weights, directions, directions)
    low, middle, high = np.linalg.eigvalsh(spread / np.trace(spread))
    determinant = low * middle * high
    if 27 * determinant < 1e-6:  # lights within about a degree of one point
        return None, None, "ILL_POSED"
    if determinant / (low * middle + low * high + middle * high) < np.radians(0.5) ** 2:  # half a degree off a great circle
        return None, None, "ILL_POSED"
    root = np.sqrt(weights)
    b = np.linalg.lstsq(directions * root[:, None], readings * root, rcond=None)[0]
    return b, spread, "OK"


def across_normal(spread, b):
    """Trace of the inverse of the spread, without its part along the normal."""
    n = b / np.linalg.norm(b)
    inverse = np.linalg.inv(spread)
    return np.trace(inverse) - n @ inverse @ n


def solve_lambert(readings, directions):
    """Least squares on every light with a reading."""
    def one(y):
        lit = (y > 0).astype(float)
        b, spread, status = fit_weighted(y, directions, lit)
        if b is None:
            return *NOTHING, status, lit
        squared, count = (lit * (y - directions @ b) ** 2).sum() / (b @ b), lit.sum()
        spare = count - 3 if (y > 0.1 * y.max()).sum() > 3 else 0.0
        return b / np.linalg.norm(b), np.sqrt(squared / count), across_normal(spread, b), squared, spare, 0.0, 0.0, status, lit

    return _per_pixel(one, readings)


def solve_robust(readings, directions, *, rounds=5):
    """The middle brightness ranks of the lit lights, re-weighted by Cauchy weights of scale 5 % of |b|."""
    def one(y):
        given = np.sort(y[y > 0])[::-1]
        if len(given) == 0:
            return *NOTHING, "DARK", np.zeros_like(y)
        bright_end = given[max((len(given) - 5) // 10, 1 if len(given) >= 5 else 0)]
        lit = 10 * y > bright_end * (1 + 1e-12)  # exactly a tenth, as eight bits often are, is shadow: not a matter of rounding
        ranked = np.sort(y[lit])[::-1]
        count = len(ranked)
        # in tenths of what may be set aside, whole numbers only, so that no rounding decides
        aside = min(10 * max(count - 8, 0), 5 * count)
        dark, bright = aside * 2 // 50, aside * 3 // 50
        kept = lit & (y >= ranked[count - dark - 1]) & (y <= ranked[bright])
        weights = kept.astype(float)
        for _ in range(rounds + 1):
            b, spread, status = fit_weighted(y, directions, weights)
            if b is None:
                return *NOTHING, status, np.zeros_like(y)
            off = (y - directions @ b) / (0.05 * np.linalg.norm(b))
            weights = kept / (1 + off**2)
        off, expected = 0.05 * off, directions @ b
        missing = ~lit & (y > 0) & (expected > 0.35 * np.linalg.norm(b)) & (y < 0.3 * expected)
        sure = lit & (10 * y > (given[0] if len(given) < 15 and given[0] > 1.5 * bright_end else bright_end) * (1 + 1e-12))
        spare, agreeing = lit.sum() + missing.sum() - 3, (1 / (1 + (off[sure] / 0.08) ** 4)).sum() - 3
        slope = max((weights * (2 * weights - 1)).sum() / weights.sum(), 0.25)  # of the influence function, per weight
        squares = (weights * off**2 * weights).sum() / slope**2
        residual = np.sqrt((weights * off**2).sum() / weights.sum())
        return (b / np.linalg.norm(b), residual, across_normal(spread, b), squares, max(weights.sum() - 3, 0), max(spare, 0),
                max(agreeing, 0), status, weights)

    return _per_pixel(one, readings)


def albedo(radiance, normal, directions, irradiance, weights):
    """[pixel, 3]: weighted least squares of radiance = ρ/π · E · max(0, n·l) in each channel."""
    pixels = radiance.shape[2]
    rho = np.zeros((pixels, 3))
    for p in range(pixels):
        for c in range(3):
            model = irradiance[:, c] * np.maximum(directions @ normal[p], 0) / np.pi
            seen = (weights[:, p] > 0) & np.isfinite(radiance[c, :, p])
            model, measured, w = model[seen], radiance[c, seen, p], weights[seen, p]
            if (w * model**2).sum() > 0:
                rho[p, c] = max((w * model * measured).sum() / (w * model**2).sum(), 0.0)
    return rho


def _per_pixel(one, readings):
    columns = [np.array(column) for column in zip(*(one(y) for y in readings.T), strict=True)]
    return Fit(*columns[:-1], columns[-1].T)
