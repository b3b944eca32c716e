"""Frames of one light at several exposures, merged: each reading is the mean of those that are not clipped.

Weights of images must not use a clipped reading while another exposure of the same light has the whole value. Solvers take every
frame as it is and leave the clipped readings out.

Source: the maximum-likelihood weight of an exposure under photon noise is the light that it gathers, Hasinoff, Durand and Freeman,
"Noise-optimal capture for high dynamic range photography", CVPR 2010, section 3; readings that saturate have weight 0.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from stage.manifest import Frame
from stage.point_lights import DistantLights
from stage.stack import Stack

SAME_PLACE_RADIANS = 1e-4
"""Lights closer than this angle, 0.006 degrees, are one light: as close as the weights of images take them for one."""


class Bracket(NamedTuple):
    """The frames of one light."""

    rows: np.ndarray  # [frames] positions in the stack
    irradiance: np.ndarray  # [frames, 3] of the light in each
    weight: np.ndarray  # [frames] in proportion to the light that each gathers


@dataclass(frozen=True)
class BracketedStack(Stack):
    """A stack in which every frame of a bracket holds the merged reading of its light, in the strength that the light has in that frame.

    A reading is marked as clipped where every frame of its light is clipped. It then holds the largest of them, which the light reaches or
    exceeds.
    """

    recorded: Stack | None = None
    """The stack of the frames as they were recorded."""
    brackets: tuple[Bracket, ...] = ()

    def band(self, start: int, stop: int) -> np.ndarray:
        """Return the merged values of a pixel range, [3, lights padded, stop - start] float16."""
        assert self.recorded is not None
        return self._merge(self.recorded.band(start, stop), self.recorded.saturated(start, stop))[0]

    def saturated(self, start: int, stop: int) -> np.ndarray:
        """Return the bits of readings that every frame of their light clips, [lights padded / 8, stop - start] uint8."""
        assert self.recorded is not None
        return self._clipped(self.recorded.saturated(start, stop))

    def pick(self, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the merged values [3, lights padded, n] float16 and bits [lights padded / 8, n] uint8 of single pixels."""
        assert self.recorded is not None
        return self._merge(*self.recorded.pick(pixels))

    def pick_saturated(self, pixels: np.ndarray) -> np.ndarray:
        """Return the bits of single pixels, [lights padded / 8, n] uint8."""
        assert self.recorded is not None
        return self._clipped(self.recorded.pick_saturated(pixels))

    def _clipped(self, bits: np.ndarray) -> np.ndarray:
        clipped = np.unpackbits(bits, axis=0, bitorder="little")
        for bracket in self.brackets:
            clipped[bracket.rows] = clipped[bracket.rows].all(axis=0)
        return np.packbits(clipped, axis=0, bitorder="little")

    def _merge(self, values: np.ndarray, bits: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        assert self.recorded is not None
        clipped = np.unpackbits(bits, axis=0, bitorder="little").astype(bool)
        merged = np.array(values)
        for rows, irradiance, weight in self.brackets:
            # radiance under an irradiance of one: the frames of a bracket agree in it
            readings = values[:, rows].astype(np.float32) * (self.recorded.scale[rows, None] / irradiance).T[..., None].astype(np.float32)
            counted = np.where(clipped[rows], 0, weight[:, None]).astype(np.float32)
            total = counted.sum(axis=0)
            mean = (readings * counted).sum(axis=1) / np.where(total > 0, total, 1)
            mean = np.where(total > 0, mean, readings.max(axis=1))
            merged[:, rows] = mean[:, None] * (irradiance / self.scale[rows, None]).T[..., None].astype(np.float32)
        return merged, self._clipped(bits)


def merge_brackets(stack: Stack, frames: Sequence[Frame], lights: DistantLights) -> Stack:
    """Return a stack whose frames of one light at several exposures are merged; without such frames, the stack as it is.

    Args:
        stack: of the frames.
        frames: of the stack, in its order.
        lights: of the frames.
    """
    exposure = np.array([frame.exposure_s or 1.0 for frame in frames])
    close = lights.direction @ lights.direction.T > 1 - SAME_PLACE_RADIANS**2 / 2
    owner = close.argmax(axis=1)  # the first light in the same place
    brackets, scale = [], stack.scale.copy()
    for first in np.unique(owner):
        rows = np.flatnonzero(owner == first)
        irradiance = lights.irradiance[rows]
        if len(rows) < 2 or not (irradiance > 0).all():
            continue
        gathered = exposure[rows] * irradiance.mean(axis=1)
        brackets.append(Bracket(rows, irradiance, gathered / gathered.sum()))
        for row, strength in zip(rows, irradiance, strict=True):  # a power of two that the largest merged value fits into
            scale[row] = np.exp2(np.ceil(np.log2((stack.scale[rows] * (strength / irradiance).max(axis=1)).max())))
    if not brackets:
        return stack
    return BracketedStack(stack.folder, stack.key, stack.frames, scale, stack.pixel_count, stack.motion, stack, tuple(brackets))
