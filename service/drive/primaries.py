"""The light that each lamp is to give → levels of its primaries.

A lamp of three primaries or fewer meets the colour as nearly as it can. One of more has many ways to the same colour; without a chart the
one of least power is taken, with a chart the one under which the camera sees the patches of the chart most nearly as under the
environment. Both are non-negative least squares, whose solution changes continuously with the light.

Source: LeGendre et al., "Practical Multispectral Lighting Reproduction", SIGGRAPH 2016, equations 1 to 3.
"""

from itertools import combinations
from typing import NamedTuple

import numpy as np
from scipy.optimize import nnls

from stage.rig.chart import ChartReadings
from stage.rig.rig import Lamp, Rig

LEAST_POWER = 1e-9
"""The weight of the squared levels beside the squared error, over the mean squared irradiance of the primaries: it decides where the colour
leaves levels open, and nowhere else."""
MOST_PRIMARIES = 8
"""Up to so many primaries every set of lit ones is tried for all lights at once; lamps of more are solved light by light."""


class WantedLevels(NamedTuple):
    """Levels without an upper limit."""

    level: np.ndarray  # [frames, emitters] float64, 0 or more
    out_of_gamut: np.ndarray  # [frames, 3] float64: irradiance that the lamps' colours cannot give, without sign; 0 with a chart


def levels_for_light(light: np.ndarray, rig: Rig, chart: ChartReadings | None) -> WantedLevels:
    """Return the levels of the primaries that give the light of each lamp, without an upper limit.

    Args:
        light: [frames, lights, 3] irradiance that each lamp is to give at the subject, in the colour space of the rig.
        rig: its lamps.
        chart: what the camera sees of the patches of a chart under each primary and under the environment; None: colours alone count.
    """
    frames = len(light)
    lamps = [np.array([primary.irradiance for primary in lamp.primaries]) for lamp in rig.lights]
    first = np.cumsum([0, *(len(matrix) for matrix in lamps)])
    level = np.zeros((frames, first[-1]))
    missed = np.zeros((frames, 3))
    alike: dict[tuple[str, ...], list[int]] = {}
    for index, lamp in enumerate(rig.lights):
        alike.setdefault(_kind(lamp), []).append(index)
    for members in alike.values():
        matrix = lamps[members[0]]  # [primaries, 3]
        wanted = light[:, members].reshape(-1, 3)
        if chart is None:
            gram, towards = matrix @ matrix.T, wanted @ matrix.T
        else:
            readings = chart.of(rig.lights[members[0]])  # [primaries, patches, 3]
            gram = np.einsum("ajk,bjk->ab", readings, readings)
            towards = wanted @ np.einsum("jk,ajk->ka", chart.target, readings)
        count = len(matrix)
        found = nonnegative_least_squares(gram + np.eye(count) * (LEAST_POWER * np.trace(gram) / count), towards)
        if chart is None:
            missed += np.abs(wanted - found @ matrix).reshape(frames, -1, 3).sum(axis=1)
        columns = first[members][:, None] + np.arange(count)
        level[:, columns] = found.reshape(frames, len(members), count)
    return WantedLevels(level, missed)


def nonnegative_least_squares(gram: np.ndarray, towards: np.ndarray) -> np.ndarray:
    """Return the non-negative x of least xᵀ G x − 2 hᵀ x, for many h.

    Args:
        gram: [n, n] float64 G, positive definite.
        towards: [count, n] float64, each h.

    Returns:
        [count, n] float64.
    """
    count = len(gram)
    found, left = np.zeros(towards.shape), np.arange(len(towards))
    sets = [lit for size in range(count, 0, -1) for lit in combinations(range(count), size)] if count <= MOST_PRIMARIES else []
    tolerance = 1e-12 * np.abs(towards).max(initial=0)
    for lit in map(list, sets):
        if not len(left):
            return found
        dark = [index for index in range(count) if index not in lit]
        given = np.linalg.solve(gram[np.ix_(lit, lit)], towards[left][:, lit].T).T
        slope = towards[left][:, dark] - given @ gram[np.ix_(lit, dark)]
        met = (given >= 0).all(axis=1) & (slope <= tolerance).all(axis=1)  # Karush, Kuhn and Tucker: only one set meets it
        found[np.ix_(left[met], lit)] = given[met]
        left = left[~met]
    factor = np.linalg.cholesky(gram).T
    for row in left[(towards[left] > tolerance).any(axis=1)]:
        found[row] = nnls(factor, np.linalg.solve(factor.T, towards[row]))[0]
    return found


def _kind(lamp: Lamp) -> tuple[str, ...]:
    """Return what lamps have in common that need the same levels for the same light."""
    return tuple(primary.model_dump_json(include={"name", "irradiance", "spectrum"}) for primary in lamp.primaries)
