"""The light that each lamp is to give → levels of its primaries, within the limits of the lamps, in steps of their bits.

A lamp of three primaries or fewer meets the colour as nearly as it can. One of more has many ways to the same colour; without a chart the
one of least power is taken, with a chart the one under which the camera sees the patches of the chart most nearly as under the
environment. Both are non-negative least squares, whose solution changes continuously with the light.

A sun brighter than a lamp becomes the smallest disc of lamps that holds its energy. Lamps at their limit that lie together are one excess.
It fills what the lamps around its middle can still give, the nearest first, with a soft rim, so that no lamp jumps while the environment
turns. Primaries of one name stand in for each other.

What rounding to steps leaves over goes to neighbouring lamps that are lit too, not to later frames.

Source: LeGendre et al., "Practical Multispectral Lighting Reproduction", SIGGRAPH 2016, equations 1 to 3; Debevec and LeGendre, "HDR
Lighting Dilation for Dynamic Range Reduction on Virtual Production Stages", SIGGRAPH 2022 Talks; error diffusion, Floyd and Steinberg, "An
adaptive algorithm for spatial grayscale", Proceedings of the SID 1976, along a tour over the lamps.
"""

from itertools import combinations
from typing import NamedTuple

import numpy as np
from scipy.optimize import nnls
from scipy.sparse.csgraph import connected_components

from kernels.relight.model.beyond import spacing
from stage.rig.chart import ChartReadings
from stage.rig.patch import drive_for_light, light_at_drive
from stage.rig.rig import Lamp, Rig

LEAST_POWER = 1e-9
"""The weight of the squared levels beside the squared error, over the mean squared irradiance of the primaries: it decides where the colour
leaves levels open, and nowhere else."""
MOST_PRIMARIES = 8
"""Up to so many primaries every set of lit ones is tried for all lights at once; lamps of more are solved light by light."""
NEIGHBOURS = 3
"""The number of lamps that what is left over is shared by."""
RIM = 0.1
"""The width of the soft rim of a disc, as a part of its radius."""
WIDEST = np.pi / 2
"""The largest radius of a disc: lamps farther away light other sides of the subject."""
TOGETHER = 2.0
"""Lamps at their limit within this many times the spacing of the lamps are one excess."""
HALVINGS = 50


class WantedLevels(NamedTuple):
    """Levels without an upper limit."""

    level: np.ndarray  # [frames, emitters] float64, 0 or more
    out_of_gamut: np.ndarray  # [frames, 3] float64: irradiance that the lamps' colours cannot give, without sign; 0 with a chart


def levels_for_light(light: np.ndarray, rig: Rig, chart: ChartReadings | None) -> WantedLevels:
    """Return the levels of the primaries that give the light of each lamp, without an upper limit.
    `light`: [frames, lights, 3] irradiance that each lamp is to give at the subject, in the colour space of the rig. `rig`: its lamps.
    `chart`: what the camera sees of the patches of a chart under each primary and under the environment; None: colours alone count."""
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
    `gram`: [n, n] float64 G, positive definite. `towards`: [count, n] float64, each h. Returns [count, n] float64."""
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


class Quantised(NamedTuple):
    """Levels that the lamps can hold."""

    step: np.ndarray  # [frames, emitters] int64, 0…255 or 0…65535
    level: np.ndarray  # [frames, emitters] float64: the light of each, 0…1


def quantise(level: np.ndarray, rig: Rig) -> Quantised:
    """Return the steps nearest to levels [frames, emitters], 0…1, with the least levels of the lamps kept."""
    step, given = np.zeros(level.shape, dtype=np.int64), np.zeros(level.shape)
    direction, emitters = rig.directions, rig.emitters
    for name in dict.fromkeys(primary.name for _, primary in emitters):
        columns = [column for column, (_, primary) in enumerate(emitters) if primary.name == name]
        tour = _tour(direction[[emitters[column][0] for column in columns]])
        columns = [columns[place] for place in tour.order]
        carried = np.zeros((len(level), len(columns)))
        energy = np.array([sum(emitters[column][1].irradiance) for column in columns])
        for place, column in enumerate(columns):
            index, primary = emitters[column]
            lamp, most = rig.lights[index], 2 ** rig.lights[index].bits - 1
            wanted = level[:, column] + carried[:, place] / energy[place]
            steps = np.rint(drive_for_light(np.clip(wanted, 0, 1), primary) * most)
            if lamp.least > 0:
                least = np.ceil(drive_for_light(np.array(lamp.least), primary) * most)
                held = np.where(wanted > light_at_drive(least / most, primary) / 2, least, 0)
                steps = np.where(steps < least, held, steps)
            steps = np.where(level[:, column] > 0, steps, 0)
            step[:, column], given[:, column] = steps, light_at_drive(steps / most, primary)
            later = tour.later[place]
            lit = (level[:, [columns[next_one] for next_one in later]] > 0) * tour.share[place]
            whole = lit.sum(axis=1, keepdims=True)
            left_over = (wanted - given[:, column])[:, None] * energy[place]
            carried[:, later] += np.divide(lit, whole, out=np.zeros(lit.shape), where=whole > 0) * left_over
    return Quantised(step, given)


class _Tour(NamedTuple):
    order: list[int]
    later: list[list[int]]  # for each place of the tour, the places of the nearest lamps that come later
    share: list[np.ndarray]  # what each of them takes


def _tour(direction: np.ndarray) -> _Tour:
    """Return a tour over lamps, each time to the nearest that is left."""
    angle = np.arccos(np.clip(direction @ direction.T, -1, 1))
    order, left = [0], set(range(1, len(direction)))
    while left:
        nearest = min(left, key=lambda lamp: (angle[order[-1], lamp], lamp))
        order.append(nearest)
        left.remove(nearest)
    ordered = angle[np.ix_(order, order)]
    later = [(np.argsort(ordered[place, place + 1 :], kind="stable")[:NEIGHBOURS] + place + 1).tolist() for place in range(len(order))]
    return _Tour(order, later, [1 / np.maximum(ordered[place, places], 1e-6) for place, places in enumerate(later)])


class Dilated(NamedTuple):
    """Levels within the limits."""

    level: np.ndarray  # [frames, emitters] float64, 0…1
    radius: np.ndarray  # [frames] float64: largest angle from the middle of an excess to a lamp that takes part of it, radians; 0: none
    left: np.ndarray  # [frames, 3] float64: irradiance that found no place, summed over the lamps


def dilate(level: np.ndarray, rig: Rig) -> Dilated:
    """Return the levels with what is above 1 given to neighbours; `level`: [frames, emitters] float64, 0 or more; `rig`: its lamps."""
    result, radius, left = np.minimum(level, 1.0), np.zeros(len(level)), np.zeros((len(level), 3))
    irradiance = np.array([primary.irradiance for _, primary in rig.emitters])
    lamp = np.array([index for index, _ in rig.emitters])
    direction = rig.directions
    reach = TOGETHER * spacing(direction)
    for name in dict.fromkeys(primary.name for _, primary in rig.emitters):
        columns = np.array([column for column, (_, primary) in enumerate(rig.emitters) if primary.name == name])
        towards, energy = direction[lamp[columns]], irradiance[columns].sum(axis=1)
        for frame in np.flatnonzero((level[:, columns] > 1).any(axis=1)):
            now = result[frame, columns]
            for members, excess in _excesses((level[frame, columns] - now) * energy, towards, reach):
                middle = excess @ towards[members]
                angle = np.arccos(np.clip(towards @ (middle / np.linalg.norm(middle)), -1, 1))
                added, rest = fill(angle, (1 - now) * energy, float(excess.sum()))
                now = np.minimum(now + added / energy, 1.0)
                radius[frame] = max(radius[frame], angle[added > 0].max(initial=0))
                colour = irradiance[columns[members]].T @ (excess / energy[members])
                left[frame] += colour * (rest / excess.sum())
            result[frame, columns] = now
    return Dilated(result, radius, left)


def fill(
    angle: np.ndarray,  # [lamps] from the middle of the excess, radians
    spare: np.ndarray,  # [lamps] energy that each can still give
    excess: float,  # energy to be placed
) -> tuple[np.ndarray, float]:
    """Return what each lamp takes of an excess, and what is left."""
    spare = np.where(angle <= WIDEST, spare, 0)
    if spare.sum() <= excess:
        return spare, excess - float(spare.sum())

    def within(radius: float) -> np.ndarray:
        return spare * np.clip((radius - angle) / (RIM * radius), 0, 1)

    low, high = 0.0, WIDEST / (1 - RIM)
    for _ in range(HALVINGS):
        radius = (low + high) / 2
        low, high = (radius, high) if within(radius).sum() < excess else (low, radius)
    taken = within(high)
    return taken * (excess / taken.sum()), 0.0


def _excesses(over: np.ndarray, towards: np.ndarray, reach: float) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the lamps of each excess and what is over at each, the largest excess first."""
    lamps = np.flatnonzero(over > 0)
    near = towards[lamps] @ towards[lamps].T >= np.cos(reach)
    count, label = connected_components(near, directed=False)
    groups = [lamps[label == index] for index in range(count)]
    return sorted(((members, over[members]) for members in groups), key=lambda group: -group[1].sum())
