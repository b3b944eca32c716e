"""The height of every pixel of a mask from that of the solved ones, so that lights find a surface wherever they shine."""

import numpy as np

from kernels.surface.components import label_runs

RINGS = 8
"""Unsolved pixels this near to solved ones are filled from their neighbours; farther ones, which few solves have, by blocks."""


def whole_surface(height: np.ndarray, solved: np.ndarray, mask: np.ndarray, *, mean_z: float, perspective: bool) -> np.ndarray:
    """Put the solved parts together, fill what is between and around them, and set the mean of the mask.

    Args:
        height: [rows, cols] float32, camera-frame z of the solved pixels; each connected part with a constant of its own.
        solved: [rows, cols] bool, one pixel or more, inside the mask.
        mask: [rows, cols] bool.
        mean_z: what the mean over the mask shall be.
        perspective: constants are factors of the depth, and not sums.

    Returns:
        [rows, cols] float32, finite everywhere. In each part of the mask the largest solved part stays, and smaller ones go to
        where it would reach them; pixels that are not solved have the mean height of solved ones around them.
    """
    out = height.astype(np.float64)
    part, whole = _labels(solved), _labels(mask)[solved]
    size = np.bincount(part[solved])
    home = np.zeros(len(size), dtype=np.int64)  # the part of the mask that each solved part lies in
    home[part[solved]] = whole
    order = np.lexsort((size, home))  # the largest of each home last
    largest = np.zeros(len(size), dtype=bool)
    largest[order[np.append(home[order][1:] != home[order][:-1], True)]] = True
    if not largest.all():
        kept = solved & largest[np.where(solved, part, 0)]
        reached = _grown(out, kept, mask)
        there, here = (np.bincount(part[solved], weights=z[solved]) / size for z in (reached, out))
        there[largest] = here[largest]
        moved = out * (there / here)[part] if perspective else out + (there - here)[part]
        out = np.where(solved, moved, out)
    out = _grown(out, solved, mask)
    mean = out[mask].mean()
    return (out * (mean_z / mean) if perspective else out + (mean_z - mean)).astype(np.float32)


def _labels(mask: np.ndarray) -> np.ndarray:
    """[rows, cols] number of the connected part of each pixel; 0 outside too."""
    runs = label_runs(mask)
    out = np.zeros(mask.shape, dtype=np.int64)
    out[mask] = np.repeat(runs.label, runs.end_col - runs.first_col)  # runs lie in the order of pixels
    return out


def _grown(height: np.ndarray, known: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """The known heights, and a height for all other pixels."""
    out, known = np.where(known, height, 0), known.copy()
    for _ in range(RINGS):
        total, count = _around(out), _around(known.astype(np.float64))
        ring = mask & ~known & (count > 0)
        if not ring.any():
            break
        out[ring] = total[ring] / count[ring]
        known |= ring
    return _filled(out, known.astype(np.float64))


def _around(values: np.ndarray) -> np.ndarray:
    """Sum of the four neighbours."""
    framed = np.pad(values, 1)
    return framed[:-2, 1:-1] + framed[2:, 1:-1] + framed[1:-1, :-2] + framed[1:-1, 2:]


def _filled(total: np.ndarray, count: np.ndarray) -> np.ndarray:
    """Mean where there is something to average; elsewhere that of the smallest block of 2, 4, 8, … pixels that holds something.

    Args:
        total, count: [rows, cols] float64, sum and number of the heights known at each place; count is above 0 somewhere.
    """
    if (count > 0).all():
        return total / count
    rows, cols = total.shape
    even = ((0, rows % 2), (0, cols % 2))
    coarse = _filled(*(np.pad(a, even).reshape(-(-rows // 2), 2, -(-cols // 2), 2).sum(axis=(1, 3)) for a in (total, count)))
    finer = coarse.repeat(2, axis=0).repeat(2, axis=1)[:rows, :cols]
    return np.where(count > 0, total / np.maximum(count, 1), finer)
