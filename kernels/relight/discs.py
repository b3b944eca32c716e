"""Far disc lights, small suns and large ones, shared out over the captured lights by samples of the disc.

The samples lie in NumPy: a few hundred directions are too few for a launch.
"""

import math

import numpy as np

from kernels.errors import ArrayError
from kernels.relight.environment import Weighting
from kernels.relight.sample_energy import share_samples

SAMPLE_PITCH_DEGREES = 1.0
"""Largest distance between two samples of a disc, degrees: finer than captured lights are apart."""
MIN_SAMPLES = 256
"""Least number of samples of a disc, so that a disc passes from one light to the next in steps of 0.4 % of its energy."""


def integrate_discs(middles: np.ndarray, angles_degrees: np.ndarray, directions: np.ndarray, *, weighting: Weighting) -> np.ndarray:
    """Share discs of even radiance out over the lights.

    Args:
        middles: [discs, 3] unit vectors to the middle of each disc.
        angles_degrees: [discs] diameter of each as seen from the object, 0…180.
        directions: [lights, 3] unit vectors from the object to the lights (without padding).
        weighting: how, as for a map.

    Returns:
        [discs, lights] float64: ∫ w L dω, for discs that give a surface facing them an irradiance of 1.

    Raises:
        ArrayError: shapes that do not fit; for smooth weighting also as integrate_smooth.

    Convention:
        A facing surface gets ∫ L cosθ dω = 1, so that the sum over the lights, ∫ L dω, is 2 / (1 + cos(angle / 2)): 1 for a small
        disc, 2 for half the sphere.
    """
    middles, directions = np.asarray(middles, dtype=np.float64), np.asarray(directions, dtype=np.float64)
    if directions.ndim != 2 or directions.shape[1] != 3 or len(directions) == 0:
        raise ArrayError(f"directions are {directions.shape}: give [lights, 3], one light or more")
    if middles.ndim != 2 or middles.shape[1] != 3 or np.shape(angles_degrees) != (len(middles),):
        raise ArrayError(f"middles are {middles.shape}, angles {np.shape(angles_degrees)}: give [discs, 3] and [discs]")
    energy = np.zeros((len(middles), len(directions)))
    for disc, (middle, angle) in enumerate(zip(middles, angles_degrees, strict=True)):
        samples = disc_samples(middle, float(angle))
        shares = share_samples(samples, np.ones((len(samples), 1)), directions, weighting=weighting)[:, 0]
        energy[disc] = shares * (2 / (1 + math.cos(math.radians(angle / 2))) / len(samples))
    return energy


def disc_samples(middle: np.ndarray, angle_degrees: float, count: int | None = None) -> np.ndarray:
    """Return directions spread evenly over a disc on the sphere, each standing for the same solid angle.

    Args:
        middle: [3] unit vector.
        angle_degrees: diameter, 0…180.
        count: of samples; None: MIN_SAMPLES, and more where they would be farther apart than SAMPLE_PITCH_DEGREES.

    Returns:
        [samples, 3] float64 unit vectors.

    Source: Vogel, "A better way to construct the sunflower head", Mathematical Biosciences 44, 1979, with even steps of the cosine.
    """
    low = 2 * math.sin(math.radians(angle_degrees / 4)) ** 2  # 1 - cosine of the rim: without the rounding near 1
    if count is None:
        count = max(MIN_SAMPLES, math.ceil(2 * math.pi * low / math.radians(SAMPLE_PITCH_DEGREES) ** 2))
    place = np.arange(count) + 0.5
    fall = place / count * low
    across = np.sqrt(fall * (2 - fall))
    turn = place * math.pi * (3 - math.sqrt(5))
    z = np.asarray(middle, dtype=np.float64)
    x = np.cross(z, np.eye(3)[np.argmin(np.abs(z))])
    x /= np.linalg.norm(x)
    return (across * np.cos(turn))[:, None] * x + (across * np.sin(turn))[:, None] * np.cross(z, x) + (1 - fall)[:, None] * z
