"""Frames of one light, merged: of several exposures the mean of those that are not clipped, of a polarised pair the sum of both.

Neither a sum of images nor a solver should take a clipped reading, or a noisy one for as much as a sure one, while another exposure of the
same light has the whole value. A cross- and a parallel-polarised image of a light are each merged first, then added (`polarised_pairs`).

Source: the maximum-likelihood weight of an exposure under photon noise is the light that it gathers, Hasinoff, Durand and Freeman,
"Noise-optimal capture for high dynamic range photography", CVPR 2010, section 3; readings that saturate have weight 0.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple, TypeVar

import numpy as np

from stage.capture.light import DistantLight, PointLight
from stage.capture.manifest import Frame
from stage.capture.point_lights import DistantLights, PlacedLights
from stage.capture.polarised_pairs import Component, first_in_place
from stage.stack.stack import LIGHT_PAD, Stack, padded

Lights = TypeVar("Lights", bound=DistantLights | PlacedLights)


class Bracket(NamedTuple):
    """The frames of one light."""

    rows: np.ndarray  # [frames] positions in the stack
    irradiance: np.ndarray  # [frames, 3] of the light in each
    weight: np.ndarray  # [frames] in proportion to the light that each gathers
    crossed: np.ndarray  # [frames] bool: the cross-polarised ones
    gains: tuple[float, float]
    """The factors of the others (all where there is no polariser) and of the cross-polarised ones in the sum."""

    def parts(self) -> Iterator[tuple[np.ndarray, float]]:
        """Yield the frames whose mean is taken, as [frames] bool, with the factor of the mean."""
        for among, gain in zip((~self.crossed, self.crossed), self.gains, strict=True):
            if among.any():
                yield among, gain


@dataclass(frozen=True)
class BracketedStack(Stack):
    """A stack in which every frame of a bracket holds the merged reading of its light, in the strength that the light has in that frame.

    A reading is marked as clipped where every frame of its light is clipped. It then holds the largest of them, which the light reaches or
    exceeds.
    """

    kept: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))  # [lights padded] rows, of the recorded stack
    recorded: Stack | None = None
    """The stack of the frames as they were recorded."""
    whole_scale: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=np.float32))
    """[recorded lights padded] Radiance of a stored 1.0 in every row of the recorded stack once it is merged."""
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
            every = [clipped[bracket.rows[among]].all(axis=0) for among, _ in bracket.parts()]
            clipped[bracket.rows] = np.any(every, axis=0)
        clipped = clipped[self.kept]
        clipped[self.light_count :] = 0
        return np.packbits(clipped, axis=0, bitorder="little")

    def _merge(self, values: np.ndarray, bits: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        assert self.recorded is not None
        clipped = np.unpackbits(bits, axis=0, bitorder="little").astype(bool)
        merged = np.array(values)
        for bracket in self.brackets:
            whole = np.zeros((len(values), values.shape[2]), np.float32)
            for among, gain in bracket.parts():
                rows, weight = bracket.rows[among], bracket.weight[among]
                # radiance under an irradiance of one: the frames of a bracket agree in it
                factor = (self.recorded.scale[rows, None] / bracket.irradiance[among]).T[..., None].astype(np.float32)
                readings = values[:, rows].astype(np.float32) * factor
                counted = np.where(clipped[rows], 0, weight[:, None]).astype(np.float32)
                total = counted.sum(axis=0)
                mean = (readings * counted).sum(axis=1) / np.where(total > 0, total, 1)
                whole += np.float32(gain) * np.where(total > 0, mean, readings.max(axis=1))
            back = (bracket.irradiance / self.whole_scale[bracket.rows, None]).T[..., None].astype(np.float32)
            merged[:, bracket.rows] = whole[:, None] * back
        merged = merged[:, self.kept]
        merged[:, self.light_count :] = 0
        return merged, self._clipped(bits)


def merge_brackets(stack: Stack, frames: Sequence[Frame], lights: DistantLights | PlacedLights, *,
                   component: Component = Component.WHOLE, leak: float = 0.0) -> Stack:
    """Return a stack whose frames of one light are merged; where every light has one frame, the stack as it is.
    `component`: what the images of a polarised pair become. `leak`: of the polarisers, `Manifest.polarizer_leak`."""
    exposure = np.array([frame.exposure_s or 1.0 for frame in frames])
    kind = np.array([frame.light.polarization if isinstance(frame.light, DistantLight | PointLight) else "none" for frame in frames])
    of_cross, of_parallel = component.gains(leak)
    owner = first_in_place(lights.place if isinstance(lights, PlacedLights) else lights.direction)
    brackets, scale = [], stack.scale.copy()
    for first in np.unique(owner):
        rows = np.flatnonzero(owner == first)
        irradiance = lights.irradiance[rows]
        if len(rows) < 2 or not (irradiance > 0).all():
            continue
        gathered = exposure[rows] * irradiance.mean(axis=1)
        gains = (1.0 if (kind[rows] == "none").all() else of_parallel, of_cross)
        brackets.append(Bracket(rows, irradiance, gathered / gathered.sum(), kind[rows] == "cross", gains))
        largest = sum(abs(gain) for _, gain in brackets[-1].parts())
        for row, strength in zip(rows, irradiance, strict=True):  # a power of two that the largest merged value fits into
            scale[row] = np.exp2(np.ceil(np.log2(largest * (stack.scale[rows] * (strength / irradiance).max(axis=1)).max())))
    if not brackets:
        return stack
    return BracketedStack(stack.folder, stack.key, stack.frames, scale, stack.pixel_count, stack.motion, kept=np.arange(len(scale)),
                          recorded=stack, whole_scale=scale, brackets=tuple(brackets))


def one_frame_a_light(stack: Stack, lights: Lights) -> tuple[Stack, Lights]:
    """Return the first frame of each bracket of a merged stack, with the frames outside brackets, and their lights."""
    if not isinstance(stack, BracketedStack):
        return stack, lights
    first = np.ones(stack.light_count, dtype=bool)
    for bracket in stack.brackets:
        first[bracket.rows[1:]] = False
    return chosen_frames(stack, lights, first)


def chosen_frames(stack: Stack, lights: Lights, chosen: np.ndarray) -> tuple[Stack, Lights]:
    """Return a stack of some of the frames, and their lights. `chosen`: [lights] bool."""
    if not isinstance(stack, BracketedStack):
        stack = BracketedStack(stack.folder, stack.key, stack.frames, stack.scale, stack.pixel_count, stack.motion,
                               kept=np.arange(len(stack.scale)), recorded=stack, whole_scale=stack.scale, clipped=stack.clipped)
    rows = np.flatnonzero(chosen)
    padding = np.zeros(padded(len(rows), LIGHT_PAD) - len(rows), dtype=np.int64)
    picked = {name: values if name == "centre" else values[rows] for name, values in lights._asdict().items()}
    return (replace(stack, frames=tuple(stack.frames[row] for row in rows), kept=np.concatenate([stack.kept[rows], padding]),
                    scale=np.concatenate([stack.scale[rows], padding]).astype(np.float32)), type(lights)(**picked))
