"""What the points of a scan err alike, beside their noise: its pose, its calibration, its lens. No mean over points makes it smaller.

Two scans lie apart by the noise of both and by what each errs as a whole. Noise differs from pixel to pixel; so the mean product of the
distances at two places near each other, which share no pixel, is the variance of the rest. What all scans err alike does not show.
"""

import numpy as np
from scipy.spatial import KDTree

from service.scans.fusion.misplaced import Readings, Sample
from stage.spread import MAD_TO_SIGMA

PIXELS_APART = 4.0
"""The distance, in pixels, from which on two places share no pixel of either scan."""
NEIGHBOURS = 16
"""Places among which one is first looked for that is far enough; twice as many where none is, until there are no more."""
OTHER_SURFACE = 4.0
"""The distance between two scans, in its robust spread, from which on they show different surfaces."""
LEAST_PAIRS = 200
"""Fewest pairs of places that tell; the mean of so few products is right to a tenth."""


def shared_sigma(samples: list[Sample], readings: list[Readings], used: list[int], pixel_m: float) -> float | None:
    """Return the standard deviation, metres, of what each scan errs as a whole at a place, over the `used` scans; None where they have
    too little in common to tell.
    `readings`: of each scan, as `misplaced.readings_of` returns them. `pixel_m`: distance between neighbouring pixels on the surface."""
    firsts = np.cumsum([0, *(len(sample.points) for sample in samples)])
    partner = np.full(firsts[-1], -1)
    for number in used:
        partner[firsts[number]:firsts[number + 1]] = _partners(samples[number].points, PIXELS_APART * pixel_m, firsts[number])
    total, count = 0.0, 0
    for other in used:
        distance = np.full(firsts[-1], np.nan)
        each = readings[other]
        spread = MAD_TO_SIGMA * float(np.median(np.abs(each.distance))) if len(each.at) else 0.0
        same = np.abs(each.distance) <= OTHER_SURFACE * np.maximum(each.expected, spread)
        distance[each.at[same]] = each.distance[same]
        products = distance[partner >= 0] * distance[partner[partner >= 0]]
        known = np.isfinite(products)
        total, count = total + float(products[known].sum()), count + int(known.sum())
    return float(np.sqrt(max(total / count, 0.0) / 2)) if count >= LEAST_PAIRS else None


def _partners(points: np.ndarray, apart_m: float, first: int) -> np.ndarray:
    """Return the nearest other point of each that is at least so far away, [n], counted from `first`; −1 where there is none."""
    tree, count = KDTree(points), min(NEIGHBOURS, len(points))
    found, left = np.full(len(points), -1), np.arange(len(points))
    while True:
        distance, at = tree.query(points[left], k=[*range(1, count + 1)])
        far = distance >= apart_m
        known = far.any(axis=1)
        found[left[known]] = first + at[known, far[known].argmax(axis=1)]
        left = left[~known]
        if len(left) == 0 or count == len(points):
            return found
        count = min(2 * count, len(points))
