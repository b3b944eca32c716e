"""Depths that a file holds in steps, as whole millimetres or disparities: their rounding is an error beside their noise.

Where steps are larger than the noise, neighbours hold one value until the surface has risen by a step. So along a run of equal depths
between two next ones the normals rise by about a step; on planes that lie one behind the other they do not rise, and nothing is rounded.
"""

import numpy as np

from service.joining.depth_steps import Edges

LEAST_RISE = 0.25
"""Mean rise of the normals along such runs over the step, long runs first, from which on depths are rounded."""
NEXT, FAR = 1.5, 3.0
"""Largest difference from a next depth, in steps, along a run; and of any two that are next to each other in median ones, for steps of
disparities grow with the depth: beyond these lies an edge."""


def rounding_step(value: np.ndarray, known: np.ndarray, right: Edges, down: Edges) -> np.ndarray:
    """Return the step from each height to the nearest other one, [rows, cols]; 0 where heights are not rounded. The arguments are those of
    `find_steps`."""
    levels, place, count = np.unique(value[known], return_inverse=True, return_counts=True)
    step = np.zeros(value.shape)
    if len(levels) < 2:
        return step
    gap = np.diff(levels)
    least = np.minimum(np.append(gap, np.inf), np.insert(gap, 0, np.inf))
    step[known] = np.where(count > 1, np.where(least < FAR * np.median(gap), least, np.median(gap)), 0)[place]
    risen, wanted = 0.0, 0.0
    for rows, here, steps, slope in ((value, known, step, right.slope), (value.T, known.T, step.T, down.slope.T)):
        line, own, rise, there = (np.pad(plane, ((0, 0), (0, 1)), constant_values=fill).reshape(-1)
                                  for plane, fill in ((rows, np.nan), (steps, 0.0), (slope, 0.0), (here, True)))
        at, total = np.flatnonzero(there), np.concatenate([[0.0], np.cumsum(rise)])  # over missing depths normals rise, too
        line, own = line[at], own[at]
        begin = np.flatnonzero(line[1:] != line[:-1]) + 1
        first, end = begin[:-1], begin[1:]
        between = np.maximum(np.abs(line[first] - line[first - 1]), np.abs(line[end] - line[first])) < NEXT * own[first]
        first, end = first[between], end[between]
        weight = (at[end] - at[first]) ** 2
        risen += float((weight * np.abs(total[at[end]] - total[at[first]])).sum())
        wanted += float((weight * own[first]).sum())
    return step if risen > LEAST_RISE * wanted else np.zeros(value.shape)
