"""The model of a surface under the light of many frames: what depends on the surface is computed once for all of them, one portion of
its pixels after another; what depends on a frame is a matrix product and a few samples."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.packs import Band
from kernels.relight.direction_grid import direction_grid
from kernels.relight.gloss_ratio import ratio_of_sums
from kernels.relight.horizon import Horizons, see_above
from kernels.relight.many_frames import combine_rows
from kernels.relight.responses import Responses, empty_responses, respond, shown_gloss
from kernels.relight.shading import Surface, upload_sources
from kernels.relight.small_lights import FrameSources, shade_frames, upload_frames
from kernels.relight.sources import far, join, own_rows
from service.light.far_light import FarSamples, captured_lights, hidden_as_captured
from service.light.lit_model import LitBeyond, LitModel
from service.light.range_light import RangeBeyond, RangeLight
from service.light.surface_model import ModelBatch, SurfaceModel
from stage.point_lights import DistantLights

RESPONSE_BYTES = 64 << 20
"""Most bytes of responses that are in memory at one time; they choose how many pixels a portion has."""


NO_SOURCES = far(np.zeros((0, 3)), np.zeros((0, 3)))


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

    def matt(self, responses: Responses, albedo: np.ndarray) -> np.ndarray:
        """Return [frames, 3, n] the diffuse part of the radiance of pixels of an albedo [3, n]."""
        count, _, terms = self.weights.shape
        sums = combine_rows(responses.matt, self.weights.reshape(3 * count, 1, terms)).numpy().reshape(count, 3, -1)
        return np.asarray(albedo * sums[self.places, :, : albedo.shape[1]])

    def gloss(self, rows: wp.array, count: int) -> np.ndarray:
        """Return [frames, 3, count] the specular part of the radiance, from rows as of Responses.gloss."""
        return np.asarray(combine_rows(rows, self.weights).numpy()[self.places, :, :count])


class ChunkLight(NamedTuple):
    """The light of the frames of a chunk, on the device as far as it is shaded."""

    broad: FrameEnergy
    captured: FrameEnergy
    small: FrameSources
    small_directions: np.ndarray  # [n, 3] of the small samples of all frames
    added: FrameEnergy | None
    beyond: "ChunkBeyond | None"


class ChunkBeyond(NamedTuple):
    """The part of it that lies beyond the captured lights."""

    broad: FrameEnergy
    captured: FrameEnergy
    small: FrameSources


class Portion(NamedTuple):
    """Neighbouring packs of a batch."""

    pixels: slice
    """The pixels of the batch that the portion covers."""
    surface: Surface
    band: Band
    visible: wp.array  # [lights, P] of the captured lights
    horizons: Horizons | None
    albedo: np.ndarray  # [3, n]


class ModelRange:
    """Lights a model of the surface for many frames."""

    def __init__(self, model: SurfaceModel, lights: DistantLights) -> None:
        """Args:
            model: the surface.
            lights: the captured lights.

        Raises:
            ArrayError: fewer than four lights, or all in one plane.
        """
        towards = direction_grid().direction
        grid = FarSamples(towards, np.ones((len(towards), 3)), np.zeros(len(towards), dtype=bool))
        self._model, self._lights = model, lights
        self._grid = upload_sources(hidden_as_captured(grid, lights.direction), model.device)
        self._captured = upload_sources(captured_lights(lights.direction, lights.irradiance), model.device)

    def chunk(self, lights: Sequence[RangeLight], places: Sequence[int]) -> ChunkLight:
        """Put the light of frames on the device.

        Args:
            lights: of each frame.
            places: position of each frame in the full chunk.
        """
        nothing = np.zeros_like(lights[0].captured)
        samples = own_rows(join([each.small for each in lights]))
        added = [nothing if each.added is None else each.added for each in lights]
        beyond = None
        if any(each.beyond is not None for each in lights):
            parts = [each.beyond or RangeBeyond(NO_SOURCES, np.zeros_like(each.broad), nothing) for each in lights]
            small = upload_frames(join([each.small for each in parts]), [each.small.count for each in parts], self._model.device)
            beyond = ChunkBeyond(FrameEnergy.of([each.broad for each in parts], places),
                                 FrameEnergy.of([each.captured for each in parts], places), small)
        return ChunkLight(FrameEnergy.of([each.broad for each in lights], places),
                          FrameEnergy.of([each.captured for each in lights], places),
                          upload_frames(samples, [each.small.count for each in lights], self._model.device), samples.place[:, :3],
                          FrameEnergy.of(added, places) if any(each.added is not None for each in lights) else None, beyond)

    def light(self, batch: ModelBatch, band: Band, scale: np.ndarray, visible: wp.array,
              light: ChunkLight) -> Iterator[tuple[slice, LitModel]]:
        """Yield the model under the light of frames, portion by portion of a batch, with the pixels of the batch that a portion has.

        Args:
            batch: pixels.
            band: captured images of the same pixels.
            scale: [lights padded] radiance of a stored 1.0.
            visible: [lights, P] of the captured lights.
            light: of the frames.
        """
        responses = seen = None
        for portion in self._portions(batch, band, visible, light.small_directions):
            packs = portion.surface.packs
            if responses is None or seen is None or responses.matt.shape[1] != packs:
                responses = empty_responses(len(self._grid.place), packs, self._model.device)
                seen = empty_responses(len(self._captured.place), packs, self._model.device)
            respond(portion.surface, self._grid, portion.visible, responses)
            respond(portion.surface, self._captured, portion.visible, seen)
            shown = shown_gloss(portion.band, portion.surface, seen, self._lights.direction, self._lights.irradiance, scale)
            yield portion.pixels, _lit(portion, responses, seen, shown, light)

    def _portions(self, batch: ModelBatch, band: Band, visible: wp.array, small: np.ndarray) -> Iterator[Portion]:
        """Cut a batch into portions whose responses fit into RESPONSE_BYTES."""
        pack, count = devices.pack_width(self._model.device), len(batch.pixels)
        step = max(1, RESPONSE_BYTES // (4 * 4 * pack * len(self._grid.place)))
        horizons = self._model.horizons(small, batch) if len(small) else None
        for first in range(0, batch.surface.packs, step):
            packs = slice(first, min(first + step, batch.surface.packs))
            pixels = slice(first * pack, min(packs.stop * pack, count))
            size = pixels.stop - pixels.start
            surface = batch.surface._replace(values=batch.surface.values[:, packs], pixel_count=size)
            images = band._replace(values=band.values[:, packs], saturated=band.saturated[:, packs], pixel_count=size)
            yield Portion(pixels, surface, images, visible[:, packs],
                          None if horizons is None else horizons._replace(tangent=horizons.tangent[:, packs]),
                          self._model.albedo(batch.pixels[pixels]))


def _lit(portion: Portion, grid: Responses, captured: Responses, shown: wp.array, light: ChunkLight) -> LitModel:
    """Return the model of a portion under the light of frames."""
    albedo, count = portion.albedo, portion.albedo.shape[1]
    energy = light.captured
    matt, gloss = light.broad.matt(grid, albedo), light.broad.gloss(grid.gloss, count)
    if portion.horizons is not None:
        visible = see_above(light.small_directions, portion.surface, portion.horizons)
        small = shade_frames(portion.surface, light.small, visible).numpy()[..., :count].reshape(-1, 2, 3, count)
        matt += small[:, 0]
        gloss += small[:, 1]
    positive = energy._replace(weights=np.maximum(energy.weights, 0))
    ratio = ratio_of_sums(positive.gloss(shown, count), positive.gloss(captured.gloss, count))
    added = beyond = None
    if light.added is not None:
        added = np.stack([light.added.matt(captured, albedo), light.added.gloss(captured.gloss, count)], axis=1)
    if light.beyond is not None:
        shine = light.beyond.broad.gloss(grid.gloss, count)
        whole = light.beyond.broad.matt(grid, albedo) + shine
        small = shade_frames(portion.surface, light.beyond.small, portion.visible).numpy()[..., :count].reshape(-1, 2, 3, count)
        stands_in = light.beyond.captured.matt(captured, albedo) + light.beyond.captured.gloss(captured.gloss, count)
        beyond = LitBeyond(whole + small.sum(axis=1), shine + small[:, 1], stands_in)
    return LitModel(matt, gloss, energy.matt(captured, albedo) + energy.gloss(shown, count), ratio, added, beyond)
