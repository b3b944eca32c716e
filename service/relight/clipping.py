"""Readings of a capture that are clipped at every exposure of their light: how much of a relit frame comes from them."""

from typing import NamedTuple

import numpy as np

from stage.stack.stack import Stack

LEVEL_MARGIN = 0.999
"""A channel is clipped where it reaches this part of the level at which its image clips; the stored half values are exact to .0005."""


class Clipping(NamedTuple):
    """Sums of the clipped readings of a stack over the object."""

    level: np.ndarray  # [lights padded] radiance at which the channels of an image clip; infinite where none does
    clipped: np.ndarray  # [3, lights padded] sum of the stored values that are clipped
    whole: np.ndarray  # [3, lights padded] sum of all stored values
    pixels: float
    """Share of the object's pixels that have a clipped reading, 0…1."""

    @classmethod
    def of(cls, stack: Stack, inside: np.ndarray) -> "Clipping":
        """Sum the readings of a stack over the pixels of the object, [pixels] bool."""
        lights = stack.shape[1]
        level, any_clipped = np.full(lights, np.inf), 0
        padded = np.zeros(stack.shape[2], dtype=bool)
        padded[: len(inside)] = inside
        bands = list(stack.bands(4 * lights))
        for start, stop in bands:
            bits = stack.saturated(start, stop)
            pixels = np.flatnonzero(bits.any(axis=0) & padded[start:stop])
            any_clipped += len(pixels)
            if len(pixels):
                clipped = _unpacked(bits[:, pixels])
                brightest = stack.band(start, stop)[:, :, pixels].max(axis=0).astype(np.float32) * stack.scale[:, None]
                level = np.minimum(level, np.where(clipped, brightest, np.inf).min(axis=1))
        sums, whole = np.zeros((3, lights)), np.zeros((3, lights))
        for start, stop in bands if any_clipped else ():
            values = stack.band(start, stop)
            whole += values.sum(axis=2, dtype=np.float64, where=padded[start:stop])
            pixels = np.flatnonzero(stack.saturated(start, stop).any(axis=0) & padded[start:stop])
            picked = values[:, :, pixels].astype(np.float32)
            sums += np.where(clipped_channels(picked, stack.saturated(start, stop)[:, pixels], stack.scale, level), picked, 0).sum(axis=2)
        return cls(level, sums, whole, any_clipped / max(int(inside.sum()), 1))

    def share(self, weights: np.ndarray) -> np.ndarray:
        """Return [frames, 3] shares, 0…1, of the light of frames that come from clipped readings, by weights [frames, 3, lights padded]."""
        clipped = (np.abs(weights) * np.maximum(self.clipped, 0)).sum(axis=2)
        whole = (np.abs(weights) * np.maximum(self.whole, 0)).sum(axis=2)
        return np.divide(clipped, whole, out=np.zeros_like(clipped), where=whole > 0)


def clipped_channels(values: np.ndarray, bits: np.ndarray, scale: np.ndarray, level: np.ndarray) -> np.ndarray:
    """Return [3, lights padded, n] bool: which channels of readings are clipped; the bits of a stack tell only that one of the three is.
    `values`: [3, lights padded, n] stored values. `bits`: [lights padded / 8, n] of the stack. `level`: [lights padded] of Clipping."""
    return _unpacked(bits) & (values.astype(np.float32) * scale[:, None] >= LEVEL_MARGIN * level[:, None])


def _unpacked(bits: np.ndarray) -> np.ndarray:
    return np.unpackbits(bits, axis=0, bitorder="little").astype(bool)
