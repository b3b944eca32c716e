"""The factor of all depths at which scans lie on each other best: where their poses are right and their unit or calibration is not, each
surface grows about its own scanner, and every scan seems misplaced."""

import numpy as np

from service.scans.fusion.misplaced import ROUNDS, Readings, Sample

LEAST_SCANS = 3
"""Fewest scans whose scale can be told from their places: two that lie apart along their lines of sight fit at some scale too."""


def common_scale(samples: list[Sample], readings: list[Readings], scanners: np.ndarray) -> tuple[float, list[Readings]]:
    """Return the factor by which the depths of all scans must be multiplied to lie on each other best, and what the readings are then.

    `readings`: of each scan, as `misplaced.readings_of` returns them. `scanners`: [N, 3] metres, world, where each scan was taken from."""
    firsts = np.cumsum([0, *(len(sample.points) for sample in samples)])
    normals = np.concatenate([sample.normals for sample in samples])
    towards = [np.einsum("ni,ni->n", normals[each.at], scanners[number] - scanners[np.searchsorted(firsts, each.at, side="right") - 1])
               for number, each in enumerate(readings)]  # how fast a point leaves the surface as the scale grows
    along, distance = np.concatenate(towards), np.concatenate([each.distance for each in readings]).astype(np.float64)
    growth = 0.0
    for _ in range(ROUNDS):
        rest = np.abs(distance + growth * along)
        weight = along / (1 + (rest / max(1.5 * float(np.median(rest)), 1e-9)) ** 2)
        growth = -float(weight @ distance) / max(float(weight @ along), 1e-12)
    return 1 + growth, [each._replace(distance=(each.distance + growth * part).astype(np.float32))
                        for each, part in zip(readings, towards, strict=True)]
