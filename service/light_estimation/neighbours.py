"""Whether what lights have is smooth in their directions, as highlights of a flat object are, or in no order, as that of a wrong table.

A coin of metal or under varnish has one highlight: lights from where it is mirrored look stronger, and any directions or brightness that
are free explain it better than a Lambertian fit. But lights that stand beside each other have it alike.
"""

import numpy as np

from service.light_estimation.lambertian import least_squares

BESIDE, SHUFFLES, IN_ORDER = 3, 5, 0.65
"""Lights that stand beside one, orders of lights with which the declared one is compared, and the part of what they leave that a right
order leaves at most: .16 to .63 of 59 glossy coins under right lights, .82 and more (9 of 10) of permuted ones."""
SMOOTH, MIN_LIGHTS_SMOOTH = 0.55, 16
"""The same part of the brightness that highlights of a coin ask for, .3 to .55, and least count of lights that tell it."""


def in_order(readings: np.ndarray, directions: np.ndarray, part: float) -> bool:
    """Return whether what lights have is told from those beside them, far better than from any others, of which it leaves this part at
    most: then it belongs to these directions, as highlights of a flat object do."""
    shuffled = np.random.default_rng(0)
    others = [_unlike_beside(readings, directions[shuffled.permutation(len(directions))]) for _ in range(SHUFFLES)]
    return _unlike_beside(readings, directions) < part * float(np.median(others))


def _unlike_beside(readings: np.ndarray, directions: np.ndarray) -> float:
    """Return by how much each light differs from what a plane through the readings of those beside it says, in the median."""
    apart = np.arccos(np.clip(directions @ directions.T, -1, 1)) + np.pi * np.eye(len(directions))
    near = np.exp(-0.5 * (apart / np.median(np.sort(apart, axis=1)[:, :BESIDE])) ** 2)
    plane = np.column_stack([np.ones(len(directions)), directions[:, :2]])
    readings = readings / np.maximum(np.abs(readings).max(axis=0), 1e-300)
    off = [reading - place @ least_squares(readings, np.repeat(weight[:, None], readings.shape[1], axis=1), plane, 1e-3)
           for reading, place, weight in zip(readings, plane, near, strict=True)]
    return float(np.median(np.abs(off)))
