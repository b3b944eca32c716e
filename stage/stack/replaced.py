"""A stack some of whose readings are replaced by estimates of what they would be, such as clipped ones."""

from dataclasses import dataclass, field

import numpy as np

from stage.stack.stack import Stack

LARGEST = np.float32(65504)
"""Largest half value."""


@dataclass(frozen=True)
class ReplacedStack(Stack):
    """A stack with other values for some readings; the saturation bits are those of the recorded stack."""

    recorded: Stack | None = None
    """The stack with the readings that are replaced."""
    pixel: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))  # [n] row-major positions, ascending
    light: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))  # [n] of each reading
    radiance: np.ndarray = field(default_factory=lambda: np.zeros((3, 0), dtype=np.float32))  # [3, n] in place of each reading

    @classmethod
    def of(cls, stack: Stack, pixel: np.ndarray, light: np.ndarray, radiance: np.ndarray) -> "ReplacedStack":
        """Return a stack with these readings in place of its own.

        Args:
            pixel: [n] row-major positions in the image.
            light: [n] positions in the stack.
            radiance: [3, n].
        """
        order = np.argsort(pixel, kind="stable")
        scale = stack.scale.copy()
        largest = np.zeros(len(scale))
        np.maximum.at(largest, light, radiance.max(axis=0, initial=0))
        over = largest > LARGEST * scale
        scale[over] = np.exp2(np.ceil(np.log2(largest[over] / LARGEST)))
        return cls(stack.folder, stack.key, stack.frames, scale, stack.pixel_count, stack.motion, stack, pixel[order], light[order],
                   radiance[:, order].astype(np.float32))

    def band(self, start: int, stop: int) -> np.ndarray:
        """Return the values of a pixel range, [3, lights padded, stop - start] float16."""
        assert self.recorded is not None
        span = slice(*np.searchsorted(self.pixel, (start, stop)))
        return self._placed(self.recorded.band(start, stop), span, self.pixel[span] - start)

    def saturated(self, start: int, stop: int) -> np.ndarray:
        """Return the bits of the recorded readings, [lights padded / 8, stop - start] uint8."""
        assert self.recorded is not None
        return self.recorded.saturated(start, stop)

    def pick(self, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return values [3, lights padded, n] float16 and bits [lights padded / 8, n] uint8 of single pixels, each given once."""
        assert self.recorded is not None
        values, bits = self.recorded.pick(pixels)
        order = np.argsort(pixels, kind="stable")
        place = np.minimum(np.searchsorted(pixels[order], self.pixel), len(pixels) - 1)
        among = np.flatnonzero(pixels[order][place] == self.pixel)
        return self._placed(values, among, order[place[among]]), bits

    def pick_saturated(self, pixels: np.ndarray) -> np.ndarray:
        """Return the bits of single pixels, [lights padded / 8, n] uint8."""
        assert self.recorded is not None
        return self.recorded.pick_saturated(pixels)

    def _placed(self, values: np.ndarray, readings: slice | np.ndarray, column: np.ndarray) -> np.ndarray:
        """Return values with some of the replaced readings in these columns."""
        assert self.recorded is not None
        placed = np.array(values)
        light = self.light[readings]
        for other in np.flatnonzero(self.scale != self.recorded.scale):
            placed[:, other] = values[:, other].astype(np.float32) * (self.recorded.scale[other] / self.scale[other])
        placed[:, light, column] = self.radiance[:, readings] / self.scale[light]
        return placed
