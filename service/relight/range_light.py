"""The light of the frames of a range, for a model of the surface whose responses to a fixed grid of directions are computed once.

Small bright places, a sun or a disc, are a few samples a frame, with shadows and highlights of their own. All other light is spread over
the directions of the grid (kernels.relight.directions.direction_grid).

On a CUDA device the energy of the frames of a chunk is uploaded once for all pixels, and the frames are corrected there; what a frame
gets is that of service.relight.model_range on the CPU.
"""

from collections.abc import Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np
import warp as wp

from kernels import packs
from kernels.device import to_numpy
from kernels.relight.directions.direction_grid import direction_grid, spread
from kernels.relight.frames.combine import combine_rows, sum_rows, upload_weights
from kernels.relight.model.beyond import share_beyond
from kernels.relight.model.guided import FramesOnDevice, FrameSums, Pixels, correct_frames
from kernels.relight.model.responses import Responses
from kernels.relight.model.shading import SourcesOnDevice, shade_frames
from kernels.relight.model.sources import Sources, disc_samples, far
from kernels.relight.shadows.horizon import see_above
from service.relight.far_light import NO_SAMPLES, FarLight, FarSamples, disc_light, hidden_as_captured
from service.relight.model_light import CapturedEnergy, weighting_beyond
from service.relight.surface_model import Portion
from service.relight.weights.weighting import share_samples
from service.requests.relight import LightWeights

SMALL_DISC_DEGREES = 20.0
"""Largest diameter of a disc that casts shadows of its own; the visibility of larger ones is interpolated from the captured lights."""
DISC_SAMPLES = 64
"""Samples of such a disc: 2° apart in the largest."""


class RangeLight(NamedTuple):
    """The light of one frame of a range."""

    small: Sources
    """Samples of small bright places, as far as they lie between the captured lights; each casts shadows of its own."""
    broad: np.ndarray  # [D, 3] energy of all other such light at the directions of the grid
    captured: np.ndarray  # [lights, 3] energy that the weighted sum of images already contains for it
    beyond: "RangeBeyond | None"
    """The rest of the environment and the discs; None: nothing lies beyond the captured lights."""
    added: np.ndarray | None  # [lights, 3] energy of the images that light keys of type captured add; None: the frame adds none


class RangeBeyond(NamedTuple):
    """Light from beyond the captured lights (kernels.relight.model.beyond), hidden as the captured lights nearest to it are."""

    small: Sources
    broad: np.ndarray  # [D, 3]
    captured: np.ndarray  # [lights, 3] energy that stands in for it in the weighted sum of images


class RangeLighting:
    """Resolves the light of frames for a model whose responses to the grid are known."""

    def __init__(self, directions: np.ndarray, weighting: LightWeights) -> None:
        """Keep what the frames have in common: unit vectors to the captured lights, [lights, 3], and the weighting."""
        self._directions, self._weighting = directions, weighting
        self._beyond = share_beyond(directions, direction_grid().direction)

    def light(self, light: FarLight, energy: CapturedEnergy) -> tuple[RangeLight, float]:
        """Return the light of one frame, and the share of its energy that is wholly beyond the captured lights, 0…1."""
        small, broad = _parts(light)
        grid = spread(broad.direction, broad.energy)
        outside = share_beyond(self._directions, small.direction)
        far_out = grid[self._beyond >= 1].sum() + small.energy[outside >= 1].sum()
        share = float(far_out / max(grid.sum() + small.energy.sum(), np.finfo(float).tiny))
        if not ((grid.any(axis=1) & (self._beyond > 0)).any() or (outside > 0).any()):
            return RangeLight(far(small.direction, small.energy), grid, energy.given, None, energy.added), share
        part, rest = small.scaled(outside), small.scaled(1 - outside)
        beyond = grid * self._beyond[:, None]
        stands_in = self._shares @ beyond + share_samples(part.direction, part.energy, self._directions,
                                                          weighting=weighting_beyond(self._weighting))
        return RangeLight(far(rest.direction, rest.energy), grid - beyond, energy.given - stands_in,
                          RangeBeyond(hidden_as_captured(part, self._directions), beyond, stands_in), energy.added), share

    @cached_property
    def _shares(self) -> np.ndarray:
        """Return [lights, D] how the light of the grid's directions is shared out over the captured lights."""
        towards = direction_grid().direction
        return share_samples(towards, np.eye(len(towards)), self._directions, weighting=weighting_beyond(self._weighting))


def _parts(light: FarLight) -> tuple[FarSamples, FarSamples]:
    """Return the small bright places of a frame's light, and the rest."""
    small, broad = [NO_SAMPLES], [NO_SAMPLES]
    if light.environment is not None:
        for found, parts in ((light.environment.parts.small, small), (light.environment.parts.broad, broad)):
            parts.append(FarSamples(found.direction @ light.rotation.T, found.energy * light.gain, np.full(len(found.energy), False)))
    for disc in light.discs:
        is_small = disc.angle_degrees <= SMALL_DISC_DEGREES
        towards = disc_samples(disc.direction, disc.angle_degrees, DISC_SAMPLES if is_small else None)
        (small if is_small else broad).append(disc_light(disc, towards))
    return FarSamples.join(small), FarSamples.join(broad)


class FrameEnergy(NamedTuple):
    """The energy of frames at fixed directions, as weights of responses to them."""

    weights: np.ndarray  # [positions, 3, n] float32; 0 where no frame stands
    places: list[int]
    """Position of each frame in the full chunk: a sum may depend on it in its last bit, and frames that are made later must be the same."""

    @staticmethod
    def of(energy: Sequence[np.ndarray], places: Sequence[int]) -> "FrameEnergy":
        """Take the energy [n, 3] of each frame."""
        weights = np.zeros((max(places) + 1, 3, len(energy[0])), dtype=np.float32)
        for place, each in zip(places, energy, strict=True):
            weights[place] = each.T
        return FrameEnergy(weights, list(places))

    def at(self, directions: np.ndarray) -> "FrameEnergy":
        """Return the energy at some of the directions, by their numbers."""
        return self._replace(weights=self.weights[:, :, directions])

    def matt(self, responses: Responses, albedo: np.ndarray) -> np.ndarray:
        """Return [frames, 3, n] the diffuse part of the radiance of pixels of an albedo [3, n]."""
        count, _, terms = self.weights.shape
        sums = to_numpy(combine_rows(responses.matt, self.weights.reshape(3 * count, 1, terms))).reshape(count, 3, -1)
        return np.asarray(albedo * sums[self.places, :, : albedo.shape[1]])

    def gloss(self, rows: wp.array, count: int) -> np.ndarray:
        """Return [frames, 3, count] the specular part of the radiance, from rows as of Responses.gloss."""
        return np.asarray(to_numpy(combine_rows(rows, self.weights))[self.places, :, :count])


class SmallLights(NamedTuple):
    """The small bright places of neighbouring frames."""

    frames: slice
    """The place of these frames in all that are made."""
    sources: SourcesOnDevice
    direction: np.ndarray  # [n, 3] of the samples of all these frames


class ChunkLight(NamedTuple):
    """The light of the frames of a chunk, on the device as far as it is shaded."""

    broad: FrameEnergy
    captured: FrameEnergy
    small: tuple[SmallLights, ...]
    added: FrameEnergy | None
    beyond: "ChunkBeyond | None"


class ChunkBeyond(NamedTuple):
    """The part of it that lies beyond the captured lights."""

    broad: FrameEnergy
    captured: FrameEnergy
    small: SourcesOnDevice


class LightOnDevice:
    """The light of the frames of a chunk on a CUDA device, and the frames."""

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
