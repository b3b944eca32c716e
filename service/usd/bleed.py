"""Colour bled outwards over the edge of the mask, so that filtering a texture does not darken the border."""

import numpy as np

_NEIGHBOURS = [(r, c) for r in (-1, 0, 1) for c in (-1, 0, 1) if (r, c) != (0, 0)]


def bleed(values: np.ndarray, known: np.ndarray, *, reach: int) -> np.ndarray:
    """Fill unknown texels from their known neighbours, ring by ring; beyond the reach, with the mean.

    Args:
        values: [rows, cols] or [rows, cols, channels] float32.
        known: [rows, cols] bool; known texels are returned as they are.
        reach: how many texels far. The mean beyond it is for the coarse mip levels.

    Returns:
        As values. Zero throughout when nothing is known.
    """
    planes = values[..., None] if values.ndim == 2 else values
    filled = np.pad(np.where(known[..., None], planes, 0), ((1, 1), (1, 1), (0, 0)))
    done = np.pad(known, 1)
    inside = np.pad(np.ones_like(known), 1)
    ring = _around(np.argwhere(done), done, inside)
    for _ in range(reach):
        if len(ring) == 0:
            break
        total = np.zeros((len(ring), planes.shape[-1]), dtype=np.float32)
        count = np.zeros((len(ring), 1), dtype=np.float32)
        for r, c in _NEIGHBOURS:
            neighbour = ring[:, 0] + r, ring[:, 1] + c
            total += filled[neighbour]  # zero where not done
            count += done[neighbour][:, None]
        filled[ring[:, 0], ring[:, 1]] = total / count
        done[ring[:, 0], ring[:, 1]] = True
        ring = _around(ring, done, inside)
    if known.any():
        filled[~done] = planes[known].mean(axis=0, dtype=np.float64)
    return filled[1:-1, 1:-1].reshape(values.shape)


def _around(texels: np.ndarray, done: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """The texels [n, 2] of the image that touch these and are not done, each once."""
    touched = np.zeros_like(done)
    for r, c in _NEIGHBOURS:
        touched[texels[:, 0] + r, texels[:, 1] + c] = True
    return np.argwhere(touched & inside & ~done)
