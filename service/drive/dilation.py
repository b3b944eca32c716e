"""Light beyond the limits of lamps → their neighbours: a sun brighter than a lamp becomes the smallest disc of lamps that holds its energy.

Lamps at their limit that lie together are one excess. It fills what the lamps around its middle can still give, the nearest first, with a
soft rim, so that no lamp jumps while the environment turns. Primaries of one name stand in for each other.

Source: Debevec and LeGendre, "HDR Lighting Dilation for Dynamic Range Reduction on Virtual Production Stages", SIGGRAPH 2022 Talks.
"""

from typing import NamedTuple

import numpy as np
from scipy.sparse.csgraph import connected_components

from kernels.relight.model.beyond import spacing
from stage.rig.rig import Rig

RIM = 0.1
"""The width of the soft rim of a disc, as a part of its radius."""
WIDEST = np.pi / 2
"""The largest radius of a disc: lamps farther away light other sides of the subject."""
TOGETHER = 2.0
"""Lamps at their limit within this many times the spacing of the lamps are one excess."""
HALVINGS = 50


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


def fill(angle: np.ndarray, spare: np.ndarray, excess: float) -> tuple[np.ndarray, float]:
    """Return what each lamp takes of an excess, and what is left.

    Args:
        angle: [lamps] from the middle of the excess, radians.
        spare: [lamps] energy that each can still give.
        excess: energy to be placed.
    """
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
