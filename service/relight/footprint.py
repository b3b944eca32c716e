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


def turns_within(pixels: np.ndarray, normal: np.ndarray, places: Callable[[np.ndarray], np.ndarray], inside: np.ndarray,
                 part: np.ndarray) -> np.ndarray:
    """Return how normals and places change across pixels [n], row-major positions: [2, n, 6] along a row, and down a column.

    Args:
        normal: [rows, cols, 3] unit normals.
        places: returns the points [m, 3] that pixels [m] show.
        inside: [rows, cols] bool, where there are any.
        part: [rows, cols] the part of the object that a pixel belongs to: no surface is continued beyond it.
    """
    rows, cols = inside.shape
    flat, there, parts = normal.reshape(-1, 3), inside.reshape(-1), part.reshape(-1)
    own = np.concatenate([flat[pixels], places(pixels)], axis=1)
    turns = np.zeros((2, len(pixels), 6), np.float32)
    for turn, step, at, last in ((turns[0], 1, pixels % cols, cols - 1), (turns[1], cols, pixels // cols, rows - 1)):
        sides = np.zeros(len(pixels), np.float32)
        for way in (-1, 1):
            beside = np.clip(pixels + way * step, 0, rows * cols - 1)
            other = np.concatenate([flat[beside], places(beside)], axis=1)
            continued = ((at != (last if way > 0 else 0)) & there[beside] & (parts[beside] == parts[pixels])
                         & ((other[:, :3] * own[:, :3]).sum(axis=1) > CONTINUES))
            turn += np.where(continued[:, None], way * (other - own), 0)
            sides += continued
        turn /= np.maximum(sides, 1)[:, None]
    return turns


def surface_within(normal: np.ndarray, place: np.ndarray, turns: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield unit normals and points, [n, 3] each, at several places of pixels; `normal` and `place` are those in their middle, and `turns`
    those of turns_within."""
    offsets = (np.arange(SIDE, dtype=np.float32) + 0.5) / SIDE - 0.5
    for along in offsets:
        for down in offsets:
            change = along * turns[0] + down * turns[1]
            moved = normal + change[:, :3]
            yield moved / np.maximum(np.linalg.norm(moved, axis=1, keepdims=True), 1e-6), place + change[:, 3:]
