"""The thickness of the parts of an object, of which a camera sees the fronts alone."""

import numpy as np

from kernels.surface.slopes import STEEPEST

TURNED_AWAY = 0.6
"""Cosine to the viewer below which the outermost pixels of a part are taken to turn away from the viewer."""


def guess_thickness(surface: np.ndarray, part: np.ndarray, facing: np.ndarray, pixel: float) -> np.ndarray:
    """Return the distance from front to back [rows, cols] of parts that are mirrored in their outlines.

    The outline is taken as plane. Where a part turns away from the viewer, its outermost pixel stands before its outline by the
    slope of a pixel, as on a sphere.

    Args:
        surface: [rows, cols] height towards the viewer.
        part: [rows, cols] int, the number of the part; below 0 there is none.
        facing: [rows, cols] cosine between the normal and the direction to the viewer.
        pixel: what a pixel spans, in the unit of the surface.
    """
    out = np.zeros(part.shape)
    framed = np.pad(part, 1, constant_values=-1)
    inner = np.logical_and.reduce([framed[1:-1, 1:-1] == side for side in (framed[:-2, 1:-1], framed[2:, 1:-1], framed[1:-1, :-2],
                                                                           framed[1:-1, 2:])])
    for number in np.unique(part[part >= 0]):
        mine = part == number
        places, outline, height = np.argwhere(mine), ~inner[mine], surface[mine]
        cells = np.column_stack([places, np.ones(len(places))])
        turned = np.clip(facing[mine][outline], STEEPEST, 1)
        before = np.where(turned < TURNED_AWAY, np.sqrt(1 - turned**2) / turned, 0) * pixel
        level = cells @ np.linalg.lstsq(cells[outline], height[outline] - before, rcond=None)[0]
        out[mine] = 2 * np.maximum(height - level, 0)
    return out
