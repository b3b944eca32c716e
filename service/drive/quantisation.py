"""Levels → steps of the lamps' bits: what rounding leaves over goes to neighbouring lamps that are lit too, not to later frames.

Source: error diffusion, Floyd and Steinberg, "An adaptive algorithm for spatial grayscale", Proceedings of the SID 1976, along a tour over
the lamps.
"""

from typing import NamedTuple

import numpy as np

from stage.rig.patch import drive_for_light, light_at_drive
from stage.rig.rig import Rig

NEIGHBOURS = 3
"""The number of lamps that what is left over is shared by."""


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
    """The order in which lamps are rounded."""

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
