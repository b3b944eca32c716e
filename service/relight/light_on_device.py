"""The light of the frames of a chunk on a CUDA device, where they are corrected: the energy of the frames is uploaded once for all pixels.

What a frame gets is that of service.relight.model_range on the CPU.
"""

from collections.abc import Sequence

import numpy as np
import warp as wp

from kernels import packs
from kernels.relight.frames.combine import sum_rows, upload_weights
from kernels.relight.model.guided import FramesOnDevice, FrameSums, Pixels, correct_frames
from kernels.relight.model.responses import Responses
from kernels.relight.model.shading import shade_frames
from kernels.relight.shadows.horizon import see_above
from service.relight.model_range import ChunkLight, FrameEnergy, Portion


class LightOnDevice:
    """The light of frames, and the frames."""

    def __init__(self, chunk: ChunkLight, frames: FramesOnDevice, places: Sequence[int]) -> None:
        """Upload the light; `places` are the numbers of the frames in `frames`."""
        self.chunk, self._frames, self._device = chunk, frames, frames.radiance.device.alias
        self._places = wp.array(np.asarray(places), dtype=wp.int32, device=self._device)
        self._broad, self._captured = self._upload(chunk.broad), self._upload(chunk.captured)
        self._given = self._upload(chunk.captured._replace(weights=np.maximum(chunk.captured.weights, 0)))
        self._added = None if chunk.added is None else self._upload(chunk.added)
        self._beyond = None if chunk.beyond is None else (self._upload(chunk.beyond.broad), self._upload(chunk.beyond.captured))

    def _upload(self, energy: FrameEnergy) -> wp.array:
        """Return [frames, 3, n] energy of the frames, with zero frames after them."""
        return upload_weights(energy.weights[energy.places], self._device)

    def correct(self, portion: Portion, pixels: Pixels, facing: wp.array, grid: Responses, captured: Responses, shown: wp.array) -> None:
        """Correct the frames at the pixels of a portion, from its responses to the directions of the grid that are `facing`."""
        nothing = wp.empty((0, 3, grid.matt.shape[1] * grid.matt.dtype._length_), dtype=wp.float32, device=self._device)
        broad = _taken(self._broad, facing)
        added = beyond = inside = (nothing, nothing)
        beyond_small = nothing
        if self._added is not None:
            added = _sums(self._added, captured)
        if self._beyond is not None and self.chunk.beyond is not None:
            beyond, inside = _sums(_taken(self._beyond[0], facing), grid), _sums(self._beyond[1], captured)
            beyond_small = shade_frames(portion.surface, self.chunk.beyond.small, portion.visible)
        sums = FrameSums(*_sums(broad, grid), _matt(self._captured, captured), sum_rows(shown, self._captured),
                         sum_rows(shown, self._given), sum_rows(captured.gloss, self._given), *added, *beyond, beyond_small, *inside)
        for lights, horizons in zip(self.chunk.small, portion.horizons, strict=True):
            if horizons is None:
                count = lights.frames.stop - lights.frames.start
                small = wp.zeros((count, 6, nothing.shape[2]), dtype=wp.float32, device=self._device)
            else:
                visible = see_above(lights.direction, portion.surface, horizons)
                small = shade_frames(portion.surface, lights.sources, visible)
            correct_frames(self._frames, self._places, lights.frames.start, sums, small, pixels)


def _sums(energy: wp.array, responses: Responses) -> tuple[wp.array, wp.array]:
    """Return the diffuse part, without the albedo, and the specular part under energy [frames, 3, n]."""
    return _matt(energy, responses), sum_rows(responses.gloss, energy)


def _matt(energy: wp.array, responses: Responses) -> wp.array:
    count, channels, terms = energy.shape
    return sum_rows(responses.matt, energy.reshape((count * channels, 1, terms))).reshape((count, channels, -1))


def _taken(energy: wp.array, facing: wp.array) -> wp.array:
    """Return the energy at some of the directions."""
    count, channels, terms = energy.shape
    taken = wp.empty((count * channels, len(facing)), dtype=wp.float32, device=energy.device)
    packs.take_columns(energy.reshape((count * channels, terms)), facing, 0, taken)
    return taken.reshape((count, channels, len(facing)))
