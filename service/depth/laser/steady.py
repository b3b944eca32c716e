"""Whether laser frames show the scene at the same place, told by its texture under the ambient light.

A frame that is moved by d shows ambient(p - d) in place of ambient(p), so that away from the stripe about -∇ambient · d is left of it (the
linear step of Lucas and Kanade, "An iterative image registration technique", IJCAI 1981). Two halves of the places are asked apart.
"""

import numpy as np
from scipy.ndimage import maximum_filter, shift

from service.depth.laser.stripes import Signal

BLOCK = 2
"""Side in pixels of the blocks whose means are compared."""
PATCH = 4
"""Side in blocks of the patches that belong to one half of the places."""
STRIPE_SIGMAS, STRIPE_BLOCKS = 5.0, 13
"""Deviations of noise from which on a reading may be light of the laser, and the side in blocks of what is left out around it."""
LEAST_TEXTURE = 20.0
"""Least sum of the squares of the ambient light's steps in each half, in variances of noise."""
MOST_PLACES = 100_000
"""Number of blocks of a half that are compared, evenly spread."""
ROUNDS, SMALL_PX = 4, 0.2
"""Number of steps, and the length in pixels below which one is small enough for its texture to be linear."""
FEWEST, LEAST_PX, LEAST_ALIKE = 6, 0.1, 0.75
"""Least number of frames, root mean square move, and correlation of the moves that both halves tell."""


class Moves:
    """Moves of laser frames against their ambient light."""

    def __init__(self, ambient: np.ndarray, mask: np.ndarray) -> None:
        """Compare frames with `ambient`, [rows, cols, 3] float32, within `mask`, [rows, cols] bool."""
        self.grey = _blocks(ambient.sum(axis=-1))
        self.steps = np.gradient(self.grey) if min(self.grey.shape) > 1 else [np.zeros_like(self.grey)] * 2
        self.inside = _blocks(mask) == 1
        self.inside[:, [0, -1]] = self.inside[[0, -1]] = False
        rows, cols = np.indices(self.grey.shape) // PATCH
        self.half = (rows + cols) % 2 == 0
        self.found: list[np.ndarray] = []

    def add(self, radiance: np.ndarray, signal: Signal) -> None:
        """Measure the move of one frame, [rows, cols, 3] less the ambient light; `signal`: of that frame."""
        seen = _blocks(radiance.sum(axis=-1)) + self.grey
        stripe = maximum_filter(_blocks(signal.values > STRIPE_SIGMAS * signal.noise) > 0, STRIPE_BLOCKS)
        least = LEAST_TEXTURE * (radiance.shape[-1] * signal.noise / BLOCK) ** 2
        self.found.append(np.array([self._move(seen, self.inside & half & ~stripe, least) for half in (self.half, ~self.half)]))

    def _move(self, seen: np.ndarray, used: np.ndarray, least: float) -> np.ndarray:
        """Return the move of a frame across and down in pixels; NaN where the texture is weaker than `least`."""
        at = np.flatnonzero(used)
        at = at[:: max(1, len(at) // MOST_PLACES)]
        move, grey, steps = np.zeros(2), self.grey, self.steps
        for _ in range(ROUNDS):
            down, across = (each.ravel()[at].astype(np.float64) for each in steps)
            if min((across**2).sum(), (down**2).sum()) < least:
                return np.full(2, np.nan)
            design = np.stack([-across, -down, grey.ravel()[at], np.ones_like(across)], axis=-1)
            step = np.linalg.lstsq(design, (seen - grey).ravel()[at], rcond=None)[0][:2] * BLOCK
            move += step
            if np.hypot(*step) < SMALL_PX:
                break
            grey = shift(self.grey, move[::-1] / BLOCK, order=1, mode="nearest")
            steps = np.gradient(grey)
        return move

    def clear(self) -> np.ndarray | None:
        """Return how far each frame lies aside of the first or of the ambient light, whichever is farther, [frames, 2] pixels across and
        down; None where the frames seem to stand still or nothing tells it. A frame that tells nothing lies as far aside as is usual."""
        moves = np.array(self.found)
        if len(moves) < FEWEST or (told := np.isfinite(moves).all(axis=(1, 2))).sum() < FEWEST:
            return None
        one, other = moves[told, 0].ravel(), moves[told, 1].ravel()
        together = float((one * other).mean())
        if together < LEAST_PX**2 or together < LEAST_ALIKE * np.sqrt((one**2).mean() * (other**2).mean()):
            return None
        move = moves.mean(axis=1)
        aside = np.maximum(np.abs(move), np.abs(move - move[told][0]))
        return np.where(told[:, None], aside, np.sqrt((aside[told] ** 2).mean(axis=0)))


def _blocks(image: np.ndarray) -> np.ndarray:
    """Return the means of whole blocks of an image, [rows, cols]."""
    rows, cols = (size // BLOCK for size in image.shape)
    return np.asarray(image[:rows * BLOCK, :cols * BLOCK].reshape(rows, BLOCK, cols, BLOCK).mean(axis=(1, 3), dtype=np.float32))
