"""Posterior over normals: how far the readings leave the normal open in every direction, near it and across the hemisphere.

Candidates on rings around a normal, each 1.8 times as wide as the one before, from a tenth of a degree to the horizon, are costed under a
table of lobes (`scores`). With the noise that the object itself shows, exp(-cost/2) times the solid angle that a candidate stands for is
its probability. Mean and second moment of that distribution are normal and standard deviation, whatever its shape: a mirror that sees one
source may look anywhere in it, one between two sources along an arc, one that sees nothing anywhere. The noise comes from what the best
normals of many pixels leave unexplained; a pixel that is explained worse than the others has a wider posterior.

Source: MacKay, "Information Theory, Inference, and Learning Algorithms", 2003, chapter 28: the evidence of a mode is its best likelihood
times the volume that the readings leave it.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import warp as wp

from kernels.device import once, to_numpy
from kernels.photometric.model.candidates import LEAST_NZ
from kernels.photometric.model.chosen_samples import choose, put
from kernels.photometric.model.response_table import nodes
from kernels.photometric.model.samples import Samples, evenly, readings_of, to_host
from kernels.photometric.posterior.scores import score_normals

INNERMOST, RATIO, MEMBERS, OUTERMOST = 0.1, 1.8, 12, 90.0
"""Angle of the first ring around the normal, degrees, ratio of each ring to the one before, candidates on a ring and largest angle: 12
rings. Finer rings change no standard deviation by more than a tenth."""
NOISE_PIXELS = 512
"""Number of pixels, spread over the sample, from which the noise is measured."""
LEAST_NOISE_PIXELS = 20
"""Least number of pixels that tell the noise; with fewer, ASSUMED is taken."""
ASSUMED = 0.05
"""Relative noise that is assumed until the pixels have told theirs, and where too few readings remain for it, as of the search."""
LEAST_SLOPE, LEAST_FLOOR = 0.008, 0.002
"""Least noise of a reading, relative to the reading and to the pixel's level: what interpolation in the table leaves."""
SLOPE_PRIOR, FLOOR_PRIOR = 0.1, 0.01
"""Weight of ASSUMED against one reading beyond the unknowns, in the squares of slope and floor: with hardly more lights than unknowns a fit
leaves no residual, and yet there is noise."""
MOST_ROUNDS = 4
"""Most times that the candidates are laid out."""
SURE = 5.0
"""Standard deviation, degrees, up to which a pixel's normal is good enough to measure noise with."""
UNKNOWNS = 4
"""Normal and two weights: what a pixel's readings have to determine before any is left to show its noise."""
OWN_NOISE, LEAST_SCALE = 4.0, 0.5
"""Number of readings that the noise of all pixels counts for against a pixel's own, and the least square of the pixel's noise over that
of all."""
BRIGHT_PIXEL = 0.1
"""Least brightest reading of a pixel, relative to that of the object, from which the relative noise is read: fainter ones hold other
light."""
BRIGHTER = 4.0
"""Largest brightness that a lobe may have where it meets a source, relative to the brightest readings of the object under that source."""
STEP = 0.05
"""Standard deviation, degrees, that the steps of the table leave in any normal."""


class Model(NamedTuple):
    """Lobes that a pixel may reflect, as a table, and how bright each may be."""

    table: wp.array  # [cells, lights, lobes] of response_table.search_table or of a reference ball
    bound: np.ndarray  # [lobes] float32, largest weights in the units of the readings


class Group(NamedTuple):
    """Sampled pixels that may reflect the same, and where their normals are looked for."""

    samples: Samples
    model: Model
    normal: np.ndarray  # [n, 3] float32, unit: near a mode of the posterior, whose candidates widen away from it


class Posterior(NamedTuple):
    """Distribution of the normal of each sampled pixel around one mode, on the host."""

    normal: np.ndarray  # [n, 3] float32, unit: the mean
    sigma: np.ndarray  # [n] float32, root of the mean squared angle from the mean, degrees
    cost: np.ndarray  # [n] float32, of the best candidate
    volume: np.ndarray  # [n] float32, logarithm of the solid angle of the candidates, by their probability relative to the best
    excess: np.ndarray  # [n] float32, the square of the pixel's noise over that of all


class Noise(NamedTuple):
    """Standard deviation of a reading y: √(absolute² + (floor · level)² + (slope · y)²)."""

    absolute: float
    """Standard deviation in units of the readings, the same at every pixel."""
    floor: float
    """Relative to the level of the pixel."""
    slope: float
    """Relative to the reading."""


def bounded(table: wp.array, samples: Samples) -> Model:
    """Return the lobes of a table, bounded so that none reads more than BRIGHTER times what the object shows of a source."""
    facing = to_numpy(table)[: len(nodes())][nodes()[:, 2] > math.sqrt(0.5)]  # without the Fresnel rise of the rim
    peak = facing.max(axis=0)
    met = peak >= np.median(peak, axis=0)  # a source behind the rim is met by no lobe
    read = np.percentile(readings_of(samples), 99.5, axis=0)[:, None]
    weight = np.where(met, read / np.maximum(peak, 1e-9), 0).max(axis=0)
    return Model(table, (BRIGHTER * weight).astype(np.float32))


def measure_noise(groups: Sequence[Group]) -> Noise:
    """Return the noise that the readings show about the best explanation of their pixels.

    The normals are moved to the mean of their posterior and the noise measured again, because normals that were found under another noise
    leave residuals of their own. The groups are pixels of one object, by what they may reflect.
    """
    total = sum(group.samples.pixel_count for group in groups)
    noise = Noise(0.0, ASSUMED, ASSUMED)
    if total < LEAST_NOISE_PIXELS:
        return noise
    spare = max(groups[0].samples.light_count - UNKNOWNS, 0)
    floor = math.sqrt((spare * LEAST_FLOOR**2 + FLOOR_PRIOR * ASSUMED**2) / (spare + FLOOR_PRIOR))
    parts = [_thinned(group, NOISE_PIXELS / total) for group in groups]
    brightest = np.concatenate([readings_of(part.samples).max(axis=1) for part in parts])
    level = np.concatenate([to_host(part.samples, part.samples.level) for part in parts])
    bright, sure = brightest > BRIGHT_PIXEL * np.percentile(brightest, 99.5), np.ones(len(brightest), bool)
    for last in (False, True):
        scores = [score_normals(part.samples, part.normal, _offsets()[:1], table=part.model.table, bound=part.model.bound,
                                noise=_of_pixels(noise, to_host(part.samples, part.samples.level))) for part in parts]
        count, squares = np.concatenate([score.dim for score in scores]).T
        absolute = math.sqrt(float(np.median(level**2 * squares / np.maximum(count - UNKNOWNS, 1))))
        count, squares = np.concatenate([score.bright for score in scores]).T
        told = bright & sure & (count > 1)
        relative = float(np.median(squares[told] / count[told])) if told.sum() >= LEAST_NOISE_PIXELS else 0.0
        slope = math.sqrt((spare * max(relative, LEAST_SLOPE**2) + SLOPE_PRIOR * ASSUMED**2) / (spare + SLOPE_PRIOR))
        noise = Noise(absolute, floor, slope)
        if not last:
            found = [normal_posterior(part, noise) for part in parts]
            parts = [part._replace(normal=one.normal) for part, one in zip(parts, found, strict=True)]
            sure = np.concatenate([one.sigma for one in found]) < SURE
    return noise


def _thinned(group: Group, fraction: float) -> Group:
    """Return a part of the pixels of a group, spread over it."""
    chosen = evenly(group.samples.pixel_count, max(1, math.ceil(fraction * group.samples.pixel_count)))
    return Group(choose(group.samples, chosen), group.model, group.normal[chosen])


def normal_posterior(group: Group, noise: Noise) -> Posterior:
    """Return the posterior of the normals of sampled pixels around one mode; waits for the device.

    The candidates are laid out again about the mean wherever it lies more than a standard deviation from their middle.
    """
    found, moved = _around(group, noise)
    for _ in range(MOST_ROUNDS - 1):
        far = moved > found.sigma
        if not far.any():
            break
        again, moved[far] = _around(Group(choose(group.samples, far), group.model, found.normal[far]), noise)
        moved[~far] = 0
        put(found, far, again)
    return found


def _around(group: Group, noise: Noise) -> tuple[Posterior, np.ndarray]:
    """Return the posterior over candidates about a normal, and [n] the angle from that normal to the mean, degrees."""
    samples, model, normal = group
    offsets, weight, shift, inside = _offsets(), _weights(), _shifts(), _cells()
    scores = score_normals(samples, normal, offsets, noise=_of_pixels(noise, to_host(samples, samples.level)), table=model.table,
                           bound=model.bound)
    spare = np.maximum(scores.lit - UNKNOWNS, 0)
    facing = _facing(normal, to_host(samples, samples.view), offsets)
    least = np.where(facing > 0, scores.cost, np.inf).min(axis=0)
    excess = np.maximum((OWN_NOISE + least) / (OWN_NOISE + spare), LEAST_SCALE)
    share = facing * weight[:, None] * np.exp(np.minimum(least - scores.cost, 0) / (2 * excess))
    total = share.sum(axis=0)
    share /= total
    mean = share.T @ shift
    variance = share.T @ ((shift**2).sum(axis=1) + inside) - (mean**2).sum(axis=1)
    return Posterior(_moved(normal, mean), np.sqrt(np.maximum(variance, 0) + STEP**2).astype(np.float32), least,
                     np.log(total).astype(np.float32), excess.astype(np.float32)), np.linalg.norm(mean, axis=1)


def _of_pixels(noise: Noise, level: np.ndarray) -> np.ndarray:
    """Return [n, 2] the constant part and the slope of the noise relative to the level of each pixel."""
    constant = np.hypot(noise.absolute / level, noise.floor)
    return np.stack([constant, np.full_like(constant, noise.slope)], axis=1).astype(np.float32)


@once
def _angles() -> tuple[float, ...]:
    count = math.ceil(math.log(OUTERMOST / INNERMOST) / math.log(RATIO))
    return tuple(INNERMOST * RATIO**ring for ring in range(count))


@once
def _offsets() -> np.ndarray:
    """Return [candidates, 4] offsets as of `candidates.rings`: the centre, then MEMBERS on each ring, turned by half a step from ring to
    ring."""
    angle = np.repeat(np.radians(_angles()), MEMBERS)
    azimuth = 2 * np.pi * (np.arange(MEMBERS) + 0.5 * (np.arange(len(_angles()))[:, None] % 2)).reshape(-1) / MEMBERS
    ring = np.stack([np.sin(angle), np.cos(angle), np.cos(azimuth), np.sin(azimuth)], axis=1)
    return np.concatenate([[[0.0, 1.0, 1.0, 0.0]], ring]).astype(np.float32)


@once
def _weights() -> np.ndarray:
    """Return [candidates] the solid angle that each stands for, up to the middle between two rings, over 2π."""
    edge = np.cos(np.radians(np.array([INNERMOST / RATIO, *_angles()]) * math.sqrt(RATIO)))
    return np.concatenate([[1 - edge[0]], np.repeat((edge[:-1] - edge[1:]) / MEMBERS, MEMBERS)])


@once
def _shifts() -> np.ndarray:
    """Return [candidates, 2] the angle from the centre along its two tangents, degrees."""
    offsets = _offsets()
    return np.degrees(np.arctan2(offsets[:, 0], offsets[:, 1]))[:, None] * offsets[:, 2:]


@once
def _cells() -> np.ndarray:
    """Return [candidates] the mean square of the angle within the cell that each stands for, degrees²: a rectangle on a ring."""
    angle = np.repeat(_angles(), MEMBERS)
    sides = (math.sqrt(RATIO) - 1 / math.sqrt(RATIO)) ** 2 + (2 * math.pi / MEMBERS) ** 2
    return np.concatenate([[INNERMOST**2 / (2 * RATIO)], angle**2 * sides / 12])


def tangents(normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return two [n, 3] tangents of each normal, those of `candidates.tangents`."""
    up = np.where(np.abs(normal[:, 2:]) < 0.9, [0.0, 0.0, 1.0], [1.0, 0.0, 0.0])
    tangent = np.cross(up, normal)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    return tangent, np.cross(normal, tangent)


def _facing(normal: np.ndarray, view: np.ndarray, offsets: np.ndarray) -> np.ndarray:
    """Return [candidates, n] the cosine between each candidate and the viewer, 0 for those that face away; it is never 0 at the centre.

    The image shows a patch of surface by this factor smaller, and so the normals of its pixels are this much rarer.
    """
    along = np.stack([(part * view).sum(axis=1) for part in (normal, *tangents(normal))])
    cosine = np.stack([offsets[:, 1], offsets[:, 0] * offsets[:, 2], offsets[:, 0] * offsets[:, 3]], axis=1) @ along
    cosine[0] = np.maximum(cosine[0], LEAST_NZ)
    return np.where(cosine >= LEAST_NZ, cosine, 0)


def _moved(normal: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """Return [n, 3] float32 normals moved by an angle along each of their tangents, degrees."""
    angle = np.radians(shift)
    size = np.linalg.norm(angle, axis=1, keepdims=True)
    tangent, other = tangents(normal)
    moved = np.cos(size) * normal + np.sinc(size / np.pi) * (angle[:, :1] * tangent + angle[:, 1:] * other)
    return (moved / np.linalg.norm(moved, axis=1, keepdims=True)).astype(np.float32)
