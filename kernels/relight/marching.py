"""Groups of light samples that share one visibility, so that a small bright light casts sharp shadows with few marches.

To march to a light is to follow the line from a pixel towards it over the height map and look for surface that stands above the line
(kernels.surface.shadows). This takes most of the time of shading, so the samples are put together in groups, and one march to the
middle of a group serves all its samples.

Source: one visibility for a cluster of lights, as in Dong, Grosch, Ritschel, Kautz and Seidel, "Real-time indirect illumination with
clustered visibility", VMV 2009.
"""

import numpy as np

from kernels.relight.sources import Sources


def grouped(sources: Sources, wanted: np.ndarray, first_row: int, *, most: int, reach: float) -> tuple[Sources, np.ndarray]:
    """Give samples the visibility of the group that they are in.

    Args:
        sources: all samples.
        wanted: [n] bool: which of them may be marched.
        first_row: of visibility, that the first group gets.
        most: groups.
        reach: how far a sample may be from the middle of its group, in the unit of places (of directions: radians).

    Returns:
        The samples, those near enough to a group with its row as their only occluder, the others as they were; and [groups, 4]
        the places of the groups. Middles are samples, chosen one after the other: the one whose energy times squared distance from
        all middles so far is largest.
    """
    chosen = np.flatnonzero(wanted)
    if not len(chosen):
        return sources, np.zeros((0, 4), np.float32)
    place = sources.place[chosen, :3].astype(np.float64)
    weight = np.abs(sources.energy[chosen]).sum(axis=1).astype(np.float64)
    middles = [int(np.argmax(weight))]
    distance = np.linalg.norm(place - place[middles[0]], axis=1)
    group = np.zeros(len(chosen), dtype=np.int32)
    while len(middles) < min(most, len(chosen)):
        farthest = int(np.argmax(weight * distance**2))
        if distance[farthest] == 0:
            break
        nearer = np.linalg.norm(place - place[farthest], axis=1)
        group[nearer < distance] = len(middles)
        distance = np.minimum(distance, nearer)
        middles.append(farthest)
    near = distance <= reach
    occluder, share = sources.occluder.copy(), sources.share.copy()
    occluder[chosen[near]] = np.stack([group[near] + first_row, *np.full((2, int(near.sum())), -1)], axis=1)
    share[chosen[near]] = (1, 0, 0)
    return sources._replace(occluder=occluder, share=share), sources.place[chosen[middles]]
