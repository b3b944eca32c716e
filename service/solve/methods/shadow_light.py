"""What shadows show of the light that an object throws on itself: whether there is any, and the scale of its albedo.

A reading in shadow is s ρ A + a ρ: the albedo ρ found so far times its unknown scale s and the light A that arrives from the other
surfaces, and stray light a that reaches every pixel. Both ρ and A are proportional to readings, so that bounced light is quadratic in their
scale and direct light is linear: the ratio tells the scale. Lit readings hardly do, because normals and lobes imitate bounced light there.
Images without bounced light, as a renderer of direct light makes them, are dark where A is not.

Sources: the robust regression is re-weighted least squares, Holland and Welsch, Communications in Statistics 1977; its covariance sums
over groups of pixels and over lights whose errors are alike, Cameron, Gelbach and Miller, "Robust inference with multiway clustering",
JBES 2011.
"""

import math
from typing import NamedTuple

import numpy as np

from kernels.device import to_numpy
from kernels.photometric.lambertian.near import LEAST_LOBE, NearField
from kernels.photometric.lambertian.readings import channel_weights
from kernels.spread import MAD_TO_SIGMA
from service.solve.height.direct_light import LARGEST_ALBEDO, DirectLight
from service.solve.height.interreflection import ArrivingLight
from stage.colour.colour import GREY_WEIGHTS

LEAST_COSINE_BEHIND = 0.1
"""A light this far behind the tangent plane (cosine below its negative) does not reach a pixel, whose normal may be wrong by 5°."""
LEAST_COSINE_CAST = 0.2
"""Least cosine of a light that casts a shadow on a pixel: below it, dark readings may be grazing light."""
DARK = 0.3
"""A reading is in cast shadow if it differs from its bounced light by less than this part of the direct light that the pixel would have."""
LIT = 0.6
"""A reading above this part of that direct light is never taken for a shadow."""
DIRECT = 1 / math.pi
"""Direct light of a surface of albedo 1 that faces a light, per irradiance."""
NOISE_FLOOR = 0.003
"""Noise of a reading over its albedo, 1 % of the direct light: smaller bounced light does not count."""
RELATIVE_NOISE = 0.3
"""Relative error of the arriving light at a pixel: patches are coarse, and not every surface is seen."""
CUTOFF = 2.0
"""Residual over its standard deviation at which the weight is one half."""
FIT_ROUNDS = 30
"""Most rounds of re-weighting."""
CONVERGED = 1e-3
"""Relative change of the scale that ends the rounds."""
MODEL_ERROR = 0.08
"""Relative error of the arriving light that all pixels share: the median on path-traced surfaces. Surfaces that the camera does not see
and gloss at grazing angles add light, so that the largest errors are too large scales."""
MOST_STRAY = 0.01
"""Most stray light, 3 % of the direct light: in a hollow that bounces evenly, stray light and bounced light look the same."""
LEAST_GROUPS = 5
"""Least number of groups of pixels, and of lights, that must show bounced light."""
LEAST_READINGS = 50
"""Least number of readings in shadow."""
SHOWN = 2.0
"""Bounced light over the noise floor at which a reading counts as showing it."""
DECIDED = 0.4
"""Largest relative standard error at which the images decide the scale."""
LEAST_SHOWN = 0.06
"""Median of the light in shadows over that which the form factors expect, below which no light has bounced: images that were rendered or
separated so have up to .011, real ones .24 and more, where dark readings are crushed, or albedo is found five times too large. Where it is
found above 1, the light that is expected is as much too large, and the limit is lower."""
LEAST_ALBEDO = 0.02
"""Pixels of less albedo say nothing of its scale: what they send on is mostly stray or specular."""
GROUPS = 12
"""Number of squares along the longer side of the image; the readings of a square err alike."""
BRIGHT_PERCENTILE = 95.0
"""Percentile of the albedo, over pixels and channels, that must stay below 1."""


class ShadowReadings(NamedTuple):
    """Readings of some pixels, of which those in shadow tell of bounced light."""

    ratio: np.ndarray
    """[n, lights] float64, reading over albedo, per irradiance; NaN where there is no reading."""
    arriving: np.ndarray
    """[n, lights] float64, reading over albedo that the light from other surfaces causes at albedo 1."""
    cosine: np.ndarray
    """[n, lights] of the angle between normal and light."""
    group: np.ndarray
    """[n] int, pixels near each other, whose errors are alike."""


class ScaleFit(NamedTuple):
    """The scale of albedo with its uncertainty."""

    scale: float
    """Albedo of the surface over the albedo that was given."""
    sigma: float
    """Standard error of the scale."""
    stray: float
    """Stray light: reading over albedo where no bounced light arrives, per irradiance."""
    readings: int
    """Number of readings in shadow."""


def fit_albedo_scale(ratio: np.ndarray, arriving: np.ndarray, cosine: np.ndarray, group: np.ndarray) -> ScaleFit | None:
    """Fit the scale of albedo to the readings in shadow.

    Args:
        ratio: [n, lights] float64, reading over albedo, per irradiance; NaN where there is no reading.
        arriving: [n, lights] float64, reading over albedo that the light from other surfaces causes at albedo 1.
        cosine: [n, lights] of the angle between normal and light.
        group: [n] int, pixels near each other, whose errors are alike.

    Returns:
        The fit, or None where the images do not decide the scale.
    """
    given = np.isfinite(ratio) & np.isfinite(arriving)
    behind = given & (cosine < -LEAST_COSINE_BEHIND)
    lit = DIRECT * cosine
    facing = given & (cosine > LEAST_COSINE_CAST) & (ratio < LIT * lit)
    groups, lights = np.broadcast_arrays(group[:, None], np.arange(ratio.shape[1]))
    scale, stray = 1.0, 0.0
    for _ in range(FIT_ROUNDS):
        direct = ratio - stray - scale * arriving
        used = behind | (facing & (np.abs(direct) < DARK * lit))
        y, x = ratio[used], arriving[used]
        if len(y) < LEAST_READINGS:
            return None
        residual = y - stray - scale * x
        dim = x <= np.median(x)
        floor = NOISE_FLOOR + MAD_TO_SIGMA * float(np.median(np.abs(residual[dim])))
        variance = floor**2 + (RELATIVE_NOISE * scale * x) ** 2
        weight = 1 / (variance * (1 + residual**2 / (CUTOFF**2 * variance)))
        design = np.stack([x, np.ones_like(x)], axis=1)
        gram = (design * weight[:, None]).T @ design
        before = scale
        if np.linalg.cond(gram / np.sqrt(np.outer(np.diag(gram) + 1e-30, np.diag(gram) + 1e-30))) > 1e6:
            return None
        scale, stray = np.linalg.solve(gram, (design * weight[:, None]).T @ y)
        bounded = not 0 <= stray <= MOST_STRAY
        if bounded:
            stray = min(max(stray, 0.0), MOST_STRAY)
            scale = float((weight * x * (y - stray)).sum() / (weight * x * x).sum())
        if scale <= 0:
            return None
        if abs(scale - before) < CONVERGED * scale:
            break
    shows = scale * x > SHOWN * NOISE_FLOOR
    if min(len(np.unique(each[used][shows])) for each in (groups, lights)) < LEAST_GROUPS:
        return None
    score = design * (weight * (y - stray - scale * x))[:, None]
    inverse = np.diag([1 / gram[0, 0], 0.0]) if bounded else np.linalg.inv(gram)
    apart = [_variance(score, inverse, labels) for labels in (groups[used], lights[used], np.arange(len(y)))]
    spread = max(apart[0] + apart[1] - apart[2], apart[0], apart[1])
    unknown = MOST_STRAY / 2 * float((weight * x).sum() / (weight * x * x).sum()) if bounded and stray > 0 else 0.0
    sigma = math.sqrt(spread + unknown**2 + (MODEL_ERROR * scale) ** 2)
    return ScaleFit(float(scale), sigma, float(stray), len(y)) if sigma < DECIDED * scale else None


def shown_bounce(ratio: np.ndarray, arriving: np.ndarray, cosine: np.ndarray, group: np.ndarray) -> float | None:
    """Return the median of readings in shadow over the light that is expected there from other surfaces, of the half of them where most is
    expected, with the arguments of `fit_albedo_scale`; or None where too few readings tell. It is 1 where light bounces as expected, and 0
    in images without bounced light."""
    behind = cosine < -LEAST_COSINE_BEHIND
    cast = (cosine > LEAST_COSINE_CAST) & (ratio < DARK * DIRECT * cosine)
    used = np.isfinite(ratio) & np.isfinite(arriving) & (behind | cast) & (arriving > SHOWN * NOISE_FLOOR)
    groups, lights = np.broadcast_arrays(group[:, None], np.arange(ratio.shape[1]))
    if used.sum() < LEAST_READINGS or min(len(np.unique(each[used])) for each in (groups, lights)) < LEAST_GROUPS:
        return None
    used &= arriving >= np.median(arriving[used])  # a wrong black level matters least there
    return float(np.median(ratio[used] / arriving[used]))


def readings_in_shadow(light: DirectLight, pixels: np.ndarray, normal: np.ndarray, readings: np.ndarray) -> ShadowReadings:
    """Return what tells of bounced light at some pixels of known normals [n, 3] and readings [n, lights], below 0 where there is none;
    under near lights divided by their falloff."""
    assert isinstance(light.arriving, ArrivingLight)
    weights = channel_weights(light.lights, GREY_WEIGHTS)
    albedo = light.albedo[:, pixels].T.astype(np.float64) * weights
    grey = np.maximum(albedo.sum(axis=1), LEAST_ALBEDO)[:, None]
    rows, cols = np.divmod(pixels, light.given.camera.width)
    corners, shares = light.arriving.at(rows, cols)
    arriving = np.einsum("nc,nk,nkcl->nl", albedo, shares, light.arriving.light[corners], optimize=True)
    given = (readings >= 0) & (grey > LEAST_ALBEDO)
    if light.field is None:
        cosine = normal @ light.lights.direction[: readings.shape[1]].T
    else:
        toward, falloff = _seen_from(light.field.at(pixels), readings.shape[1])
        cosine = np.einsum("nk,nlk->nl", normal, toward)
        given &= falloff > 0
        arriving = arriving / np.where(falloff > 0, falloff, 1)
    square = max(light.given.mask.shape) / GROUPS
    group = (rows // square * (GROUPS + 1) + cols // square).astype(int)
    return ShadowReadings(np.where(given, readings.astype(np.float64) / grey, np.nan), arriving / grey, cosine, group)


def has_bounced(light: DirectLight, shown: float | None) -> bool:
    """Return whether the light that shadows show, of `shown_bounce`, leaves it possible that light has bounced."""
    return shown is None or shown >= LEAST_SHOWN * min(1.0, largest_scale(light))


def largest_scale(light: DirectLight) -> float:
    """Return the scale of albedo above which bright pixels would send on more light than they get."""
    brightest = float(np.percentile(light.albedo[:, to_numpy(light.solved).reshape(-1) > 0].max(axis=0), BRIGHT_PERCENTILE))
    return LARGEST_ALBEDO / max(brightest, 1e-6)


def _seen_from(field: NearField, lights: int) -> tuple[np.ndarray, np.ndarray]:
    """Return unit directions to lights [n, lights, 3], and what arrives of each at normal incidence per strength [n, lights], 0 where it
    hardly shines."""
    place, lobe = (each[:lights].astype(np.float64) for each in field.places)
    way = place[:, :3] - place[:, 3:] * field.points.T.astype(np.float64)[:, None]
    distance = np.maximum(np.linalg.norm(way, axis=-1), 1e-10)
    toward = way / distance[..., None]
    shining = np.maximum(-(lobe[:, :3] * toward).sum(axis=-1), 0) ** lobe[:, 3]  # 0 to the power 0 is 1
    return toward, np.where(shining < LEAST_LOBE, 0, shining / np.where(place[:, 3] == 1, distance**2, 1))


def _variance(score: np.ndarray, inverse: np.ndarray, label: np.ndarray) -> float:
    """Return the variance of the scale where readings of one label err alike; `score` [readings, 2] are derivatives of the cost."""
    numbers = np.unique(label, return_inverse=True)[1]
    sums = np.stack([np.bincount(numbers, weights=column) for column in score.T], axis=1)
    count = len(sums)
    return float((inverse @ (sums.T @ sums) @ inverse)[0, 0]) * count / max(count - 1, 1)
