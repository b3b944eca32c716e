"""Rows or columns that disagree in turn: every second one shows another time than those between, as where two clocks or scans interlace."""

import numpy as np

SAME_WIDTHS, OTHER_WIDTHS = 1.0, 2.0
"""Differences of time, in pulse widths (and bins, where these are wider), up to which two pixels agree and from which they disagree."""
LEAST_PART = 0.02
"""Part of the pixels from which alternation is no chance and no thin object."""


def interlaced(position: np.ndarray, there: np.ndarray, width: float) -> np.ndarray:
    """Return where a pixel agrees with the second pixels on both sides and the ones between agree with each other alone, [rows, cols] bool.

    Args:
        position: [rows, cols] times in bins.
        there: [rows, cols] bool, where there is one.
        width: of the pulse, in bins.

    Returns:
        The pixels of both kinds, along rows or columns; none at all where fewer than LEAST_PART of the pixels are.
    """
    unit = max(width, 1.0)
    found = np.zeros(position.shape, dtype=bool)
    for axis in (0, 1):
        times, present = np.moveaxis(position, axis, 0), np.moveaxis(there, axis, 0)
        if len(times) < 5:
            continue
        shown = np.moveaxis(found, axis, 0)
        near = [times[k : len(times) - 4 + k] for k in range(5)]
        all_there = np.logical_and.reduce([present[k : len(times) - 4 + k] for k in range(5)])
        same = ((np.abs(near[0] - near[2]) < SAME_WIDTHS * unit) & (np.abs(near[4] - near[2]) < SAME_WIDTHS * unit)
                & (np.abs(near[1] - near[3]) < SAME_WIDTHS * unit))
        other = (np.abs(near[1] - near[2]) > OTHER_WIDTHS * unit) & (np.abs(near[3] - near[2]) > OTHER_WIDTHS * unit)
        comb = all_there & same & other
        for k in range(1, 4):
            shown[k : len(times) - 4 + k] |= comb
    return found if found[there].size and found[there].mean() > LEAST_PART else np.zeros_like(found)
