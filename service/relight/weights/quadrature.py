"""Kernel weighting: the weights with which a sum over the captured lights comes closest to the integral over all directions.

A pixel's radiance under light from direction ω is taken for a random function of ω, of which the captured images are readings: a field
of unknown mean and of Matérn covariance (1 + √3 r/ρ) exp(−√3 r/ρ) at distance r = |ω − ω'|, whose range ρ is twice the distance between
neighbouring lights. The weights have the least expected squared error of ∫ L I dω among those that are not negative and whose sum is
∫ L dω. So light from a captured direction gives that light's image, no energy is lost, and no frame is darker than 0 where no image is.

A map is shared out in layers of brightness, each with weights that are not negative: the weights of a sun, some of them below 0, would
be held at 0 together with those of the sky behind it, and take away its light.

Light from beyond the captured lights (kernels.relight.model.beyond) is shared out by `share_smooth`, because a field that is unknown there
would put it on the rim alone.

Source: kernel (Bayesian) quadrature, O'Hagan, "Bayes–Hermite quadrature", Journal of Statistical Planning and Inference 1991, and Briol et
al., "Probabilistic integration", Statistical Science 2019, section 2; the covariance and the unknown mean are those of Rasmussen and
Williams, "Gaussian Processes for Machine Learning", 2006, equations 4.17 and 2.41; non-negative by block principal pivoting, Portugal,
Júdice and Vicente, "A comparison of block pivoting and interior-point algorithms for linear least squares problems with nonnegative
variables", Mathematics of Computation 1994.
"""

from functools import lru_cache
from math import ceil
from typing import NamedTuple

import numpy as np

from kernels.errors import ArrayError
from kernels.relight.directions.latlong import check, first_of_equals
from kernels.relight.model.beyond import share_beyond
from kernels.relight.weights.environment_sources import sample_environment
from service.relight.weights.triangulation import share_smooth

NEIGHBOURS = 6
"""Number of lights around one, as a triangular lattice has them."""
RANGE = 2.0
"""The range ρ in distances between neighbouring lights. The error of frames hardly depends on it from 1 to 3 (docs/relight_methods.md)."""
SAMPLES = 2048
"""Most samples of a map: under an even sky they are 5° wide, and finer where the map is bright. The energies of 128 lights are within
0.1 %, root mean square, of those of twenty times as many samples."""
MIN_ROWS = 180
"""Least rows of samples that a map is cut from; texels of coarser maps are cut finer, because they stand for areas."""
LAYER, MORE = 64.0, 1.5
"""Radiance of the brightest over that of the dimmest light of a layer of a map, and energy over that of all dimmer light with which a layer
is one of its own. The dark side of a matt ball keeps 89 % of the light of an even sky, or more, beside windows up to 300 times as bright
(32 lights; 98 % with 96); in one layer 49 %, and nothing under a sun. Each layer leaves more of its light to neighbouring images: layers of
16 double the error of three soft lamps, and a sun of the energy of the sky is 1.2 % off in place of 0.9 % (331 lights)."""
CHUNK_VALUES = 1 << 15
"""Number of values of the kernel that are computed at one time: they stay in the cache."""
ROUNDING = 1e-9
"""Weights above minus this part of their sum are not negative but rounded."""
PATIENCE = 5
"""Number of exchanges of all wrong signs at one time that may fail to reduce their number before a single one is exchanged; single ones
come to an end (Murty 1974)."""
MOST_EXCHANGES = 1000
"""More exchanges than were ever needed; a bound against rounding that goes in circles."""
REMEMBERED = 4
"""Number of sets of lights whose inverse is kept in memory."""


def integrate_kernel(environment: np.ndarray, directions: np.ndarray, rotations: np.ndarray) -> np.ndarray:
    """Share a lat-long map out over the lights by kernel quadrature; arguments are those of weighting.integrate.
    Returns [frames, lights, 3] float64 energy of each light, 0 or above; it sums to that of the map. Of lights in one place the first
    gets all."""
    directions, rotations = check(environment, directions, rotations)
    parts = ceil(MIN_ROWS / len(environment))
    samples = sample_environment(environment if parts == 1 else environment.repeat(parts, axis=0).repeat(parts, axis=1), SAMPLES)
    offset = np.pi / len(environment) * ((np.arange(parts) + 0.5) / parts - 0.5)
    energy = samples.energy / np.cos(offset).mean()  # a texel's solid angle is that of its middle row (kernels.relight.directions.latlong)
    parts_of = layer_parts(samples.energy.sum(axis=1), samples.solid_angle)
    layers = (parts_of[..., None] * energy[:, None]).reshape(len(energy), 3 * parts_of.shape[1])
    shared = np.stack([share_kernel(samples.direction @ rotation.T, layers, directions) for rotation in rotations])
    return np.asarray(shared.reshape(len(rotations), len(directions), -1, 3).sum(axis=2))


def layer_parts(energy: np.ndarray, solid_angle: np.ndarray) -> np.ndarray:
    """Return [samples, layers] the parts of each sample in each layer of radiance; they sum to 1.
    `energy`: [samples] of all channels, above 0; `solid_angle`: [samples] steradians. A layer ends LAYER times below the brightest
    radiance, LAYER times below that and so on, where there is light on both sides, and has more than MORE times the energy of all that is
    dimmer."""
    if not len(energy):
        return np.ones((0, 1))
    radiance = energy / solid_angle
    top = radiance.max()
    below = np.minimum(radiance[:, None], top / LAYER ** np.unique(np.floor(np.log(top / radiance) / np.log(LAYER)))[::-1])  # dimmest first
    whole = solid_angle @ below
    kept = np.append(np.diff(whole) > MORE * whole[:-1], True)
    return np.diff(below[:, kept], axis=1, prepend=0.0) / radiance[:, None]


def share_kernel(samples: np.ndarray, energy: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Share the energy [n, channels] of samples, 0 or above, out over the captured lights by kernel quadrature.
    Returns [lights, channels] float64, 0 or above; its sum is that of the samples. Of lights in one place the first gets all. If the
    lights are fewer than four or all in one plane, light from beyond them is shared out by the kernel too."""
    kept = first_of_equals(directions)
    towards = np.ascontiguousarray(directions[kept], dtype=np.float64)
    given = np.zeros((len(directions), energy.shape[1]))
    beyond = share_beyond(towards, samples)
    if beyond.any():
        outside = beyond > 0
        try:
            given[kept] = share_smooth(samples[outside], energy[outside] * beyond[outside, None], towards)
            energy = energy * (1 - beyond)[:, None]
        except ArrayError:  # no triangles
            pass
    solved = quadrature_of(towards)
    moments = np.zeros((len(kept) + 1, energy.shape[1]))
    size = max(1, CHUNK_VALUES // len(kept))
    for begin in range(0, len(samples), size):
        part = slice(begin, begin + size)
        moments[:-1] += _covariance(towards, samples[part], solved.range) @ energy[part]
    moments[-1] = energy.sum(axis=0)
    best = solved.inverse[:-1] @ moments
    held = np.zeros(len(kept), dtype=bool)  # for the first channel; the next one is likely to hold the same lights
    for channel, whole in enumerate(moments[-1]):
        if whole > 0:
            weights, held = _non_negative(solved.inverse[:-1, :-1], best[:, channel] / whole, held)
            given[kept, channel] += weights * (whole / weights.sum())
    return given


class Quadrature(NamedTuple):
    """The matrix that serves every integral over the lights: the weights of least expected error are inverse[:-1] @ moments."""

    range: float
    """ρ, as a distance between unit vectors."""
    inverse: np.ndarray  # [lights + 1, lights + 1] of the covariance between the lights, bordered by ones for the sum of the weights


def quadrature_of(directions: np.ndarray) -> Quadrature:
    """Return the quadrature of lights [lights, 3], unit vectors, all in different places."""
    return _solve(np.ascontiguousarray(directions, dtype=np.float64).tobytes())


@lru_cache(maxsize=REMEMBERED)
def _solve(directions_bytes: bytes) -> Quadrature:
    """Return what lights [lights, 3] float64 need; the result is kept, because every frame asks for the same one."""
    directions = np.frombuffer(directions_bytes).reshape(-1, 3)
    count = len(directions)
    distance = np.sort(_distance(directions, directions), axis=1)[:, 1 : 1 + NEIGHBOURS]
    length = RANGE * float(np.median(distance.mean(axis=1))) if count > 1 else RANGE
    covariance = _covariance(directions, directions, length)
    return Quadrature(length, np.linalg.inv(np.block([[covariance, np.ones((count, 1))], [np.ones((1, count)), np.zeros((1, 1))]])))


def _distance(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return |a − b| of unit vectors, [a, b]."""
    distance = a @ b.T
    distance *= -2
    distance += 2
    np.maximum(distance, 0, out=distance)
    return np.sqrt(distance, out=distance)


def _covariance(a: np.ndarray, b: np.ndarray, length: float) -> np.ndarray:
    """Return Matérn's covariance of smoothness 3/2 and range `length` between unit vectors, [a, b]."""
    scaled = _distance(a, b)
    scaled *= np.sqrt(3) / length
    falling = np.exp(-scaled)
    scaled += 1
    return np.multiply(scaled, falling, out=scaled)


def _non_negative(inverse: np.ndarray, best: np.ndarray, held: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the weights of least expected error among those that are not negative, and which of them are held at zero.
    `inverse`: [lights, lights] block of the bordered inverse. `best`: [lights] weights of least expected error whatever their signs;
    they sum to one. `held`: [lights] bool, a guess of those that are held at zero."""
    held = held.copy()
    fewest, patience = len(best) + 1, PATIENCE
    for _ in range(MOST_EXCHANGES):
        force = np.linalg.solve(inverse[np.ix_(held, held)], -best[held])  # that holds them
        weights = best + inverse[:, held] @ force
        weights[held] = force
        wrong = np.flatnonzero(weights < -ROUNDING)  # negative weights, and held ones that would not become negative
        weights[held] = 0
        if not len(wrong):
            break
        if len(wrong) < fewest:
            fewest, patience = len(wrong), PATIENCE
        elif patience:
            patience -= 1
        else:
            wrong = wrong[-1:]
        held[wrong] ^= True
    return np.maximum(weights, 0), held
