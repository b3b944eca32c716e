"""How normals turn within a pixel, which decides whether one place of it stands for all.

A curved surface shows a near lamp as a highlight that may be narrower than a pixel. Lit at its middle alone, a pixel has all of it or
nothing, where a camera sees the mean. So pixels whose normal turns by more than a part of the width of their lobe are lit at several
places, to which the surface is continued from the neighbours.

Source: the widths of lobe and footprint in the plane of normals are compared as by Kaplanyan et al., "Filtering distributions of normals
for shading antialiasing", HPG 2016; the mean is that of a grid of places.
"""

from collections.abc import Callable, Iterator

import numpy as np

SIDE = 3
"""Places along each side of a pixel."""
NARROW = 0.5
"""Part of the width α of a lobe, as a slope of normals: a normal that turns by less from side to side widens the lobe by 2 %."""
CONTINUES = 0.5
"""Least cosine between the normals of neighbours that are one surface; beyond lies an edge."""


def turns_within(pixels: np.ndarray, values: Callable[[np.ndarray], np.ndarray], normal: np.ndarray, inside: np.ndarray,
                 part: np.ndarray) -> np.ndarray:
    """Return how a quantity changes across pixels [n], row-major positions: [2, n, 3] along a row, and down a column.

    Args:
        values: returns the quantity [m, 3] of pixels [m].
        normal: [rows, cols, 3] unit normals.
        inside: [rows, cols] bool, where there are any.
        part: [rows, cols] the part of the object that a pixel belongs to: no surface is continued beyond it.
    """
    rows, cols = inside.shape
    flat, there, parts = normal.reshape(-1, 3), inside.reshape(-1), part.reshape(-1)
    own, facing = values(pixels), flat[pixels]
    turns = np.zeros((2, len(pixels), 3), np.float32)
    for turn, step, at, last in ((turns[0], 1, pixels % cols, cols - 1), (turns[1], cols, pixels // cols, rows - 1)):
        sides = np.zeros(len(pixels), np.float32)
        for way in (-1, 1):
            beside = np.clip(pixels + way * step, 0, rows * cols - 1)
            continued = ((at != (last if way > 0 else 0)) & there[beside] & (parts[beside] == parts[pixels])
                         & ((flat[beside] * facing).sum(axis=1) > CONTINUES))
            turn += np.where(continued[:, None], way * (values(beside) - own), 0)
            sides += continued
        turn /= np.maximum(sides, 1)[:, None]
    return turns


def places_within() -> Iterator[tuple[float, float]]:
    """Yield the places within a pixel at which it is lit: parts of it to the right of its middle, and below."""
    offsets = (np.arange(SIDE) + 0.5) / SIDE - 0.5
    for along in offsets:
        for down in offsets:
            yield float(along), float(down)
