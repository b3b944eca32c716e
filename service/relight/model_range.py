"""The model of a surface under the light of many frames: what depends on the surface is computed once for all of them, one portion of
its pixels after another; what depends on a frame is a matrix product and a few samples. The pixels of a portion have like normals, so that
the directions behind all of them, where responses are 0, are left out."""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import groupby
from queue import SimpleQueue
from typing import NamedTuple

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.device import to_numpy
from kernels.packs import Band
from kernels.relight.directions.direction_grid import direction_grid
from kernels.relight.directions.facing import facing_directions
from kernels.relight.model.beyond import followed, trusted
from kernels.relight.model.captured import Captured
from kernels.relight.model.gloss_ratio import ratio_of_sums
from kernels.relight.model.responses import Responses, empty_responses, respond, shown_gloss
from kernels.relight.model.shading import SourcesOnDevice, shade_frames, upload_sources
from kernels.relight.model.sources import far, join, own_rows
from kernels.relight.shadows.horizon import see_above
from service.relight.far_light import FarSamples, captured_lights, hidden_as_captured
from service.relight.range_light import ChunkBeyond, ChunkLight, FrameEnergy, RangeBeyond, RangeLight, SmallLights
from service.relight.surface_model import ModelBatch, Portion, SurfaceModel
from stage.capture.point_lights import DistantLights

RESPONSE_BYTES, CUDA_RESPONSE_BYTES = 16 << 20, 256 << 20
"""Most bytes of responses that a thread of the CPU and a CUDA device keep at one time, on a device with much memory more; they choose how
many pixels a portion has."""
CUDA_PORTIONS = 8
"""Least number of portions of a batch on CUDA: pixels of all normals have no directions behind them."""
HORIZON_FRAMES = 32
"""Number of neighbouring frames for whose small lights horizons are found together: they are told apart as finely as these lights need."""
NO_SOURCES = far(np.zeros((0, 3)), np.zeros((0, 3)))


class LitModel(NamedTuple):
    """The model of some pixels under the light of one frame or of several ([frames, 3, n] in place of [3, n])."""

    matt: np.ndarray  # [3, n] diffuse part under the light between the captured lights
    gloss: np.ndarray  # [3, n] specular part under it
    whole: np.ndarray  # [3, n] what the weighted sum of images contains for it, with gloss as bright as the images show it
    ratio: np.ndarray  # [3, n] of image to model that the gloss has there (kernels.relight.model.gloss_ratio)
    added: "np.ndarray | None"  # [2, 3, n] diffuse and specular part of the captured images that the frame adds
    beyond: "LitBeyond | None"
    """The surface under the light from beyond the captured lights; None: there is none."""


class LitBeyond(NamedTuple):
    """The model under the light from beyond the captured lights."""

    whole: np.ndarray  # [3, n]
    gloss: np.ndarray  # [3, n] the specular part of it
    captured: np.ndarray  # [3, n] under what stands in for it in the weighted sum of images


class ModelRange:
    """Lights a model of the surface for many frames."""

    def __init__(self, model: SurfaceModel, lights: DistantLights) -> None:
        """Prepare the model for the captured lights, four or more, not all in one plane."""
        self._towards = direction_grid().direction
        grid = FarSamples(self._towards, np.ones((len(self._towards), 3)), np.zeros(len(self._towards), dtype=bool))
        self._model, self._lights = model, lights
        self._grid = hidden_as_captured(grid, lights.direction)
        self._captured = upload_sources(captured_lights(lights.direction, lights.irradiance), model.device)
        self._ahead: dict[tuple[int, int], tuple[wp.array, SourcesOnDevice]] = {}
        """On CUDA the directions of the grid that light each portion, by `_key`."""

    def chunk(self, lights: Sequence[RangeLight], places: Sequence[int]) -> ChunkLight:
        """Put the light of frames on the device; `places` are the positions of the frames in the full chunk."""
        nothing = np.zeros_like(lights[0].captured)
        added = [nothing if each.added is None else each.added for each in lights]
        beyond = None
        if any(each.beyond is not None for each in lights):
            parts = [each.beyond or RangeBeyond(NO_SOURCES, np.zeros_like(each.broad), nothing) for each in lights]
            small = upload_sources(join([each.small for each in parts]), self._model.device, [each.small.count for each in parts])
            beyond = ChunkBeyond(FrameEnergy.of([each.broad for each in parts], places),
                                 FrameEnergy.of([each.captured for each in parts], places), small)
        has_added = any(each.added is not None for each in lights)
        return ChunkLight(FrameEnergy.of([each.broad for each in lights], places),
                          FrameEnergy.of([each.captured for each in lights], places), tuple(self._small_lights(lights, places)),
                          FrameEnergy.of(added, places) if has_added else None, beyond)

    def _small_lights(self, lights: Sequence[RangeLight], places: Sequence[int]) -> Iterator[SmallLights]:
        """Yield the small lights of frames, some neighbouring frames at a time."""
        done = 0
        for _, members in groupby(places, key=lambda place: place // HORIZON_FRAMES):
            frames = slice(done, done + len(list(members)))
            samples = own_rows(join([each.small for each in lights[frames]]))
            sources = upload_sources(samples, self._model.device, [each.small.count for each in lights[frames]])
            yield SmallLights(frames, sources, samples.place[:, :3])
            done = frames.stop

    def light(self, batch: ModelBatch, band: Band, scale: np.ndarray, visible: wp.array, light: ChunkLight,
              use: Callable[[slice, LitModel], None]) -> None:
        """Light the model for frames on the CPU, portion by portion of a batch; every thread lights portions of its own.

        Args:
            visible: [lights, P] of the captured lights.
            use: called, by several threads, with the pixels of the batch that a portion has, and the model there.
        """
        device = self._model.device
        packs = self._portion_packs(batch.surface.packs)
        memory: SimpleQueue[tuple[Responses, Responses]] = SimpleQueue()
        for _ in range(devices.worker_count()):
            memory.put(self._room(packs))

        def work(portion: Portion) -> None:
            room = memory.get()
            try:
                facing = self._facing(portion)
                sources = upload_sources(self._grid.taken(facing), device)
                grid, captured, shown = self._responses(portion, sources, *room, scale)
                use(portion.pixels, _summed(portion, self._model.albedo(portion.position), grid, facing, captured, shown, light))
            finally:
                memory.put(room)

        with ThreadPoolExecutor(devices.worker_count(), thread_name_prefix="relit-model") as pool:
            list(pool.map(work, self._portions(batch, band, visible, light.small, packs)))

    def light_on_device(self, batch: ModelBatch, band: Band, scale: np.ndarray, visible: wp.array, light: ChunkLight,
                        use: Callable[[Portion, wp.array, Responses, Responses, wp.array], None]) -> None:
        """Light the model on CUDA, portion by portion of a batch; not synchronised.

        Args:
            visible: [lights, P] of the captured lights.
            use: called with a portion, the numbers of the directions of the grid that light it, its responses to these and to the captured
                lights, and the gloss that the images show under the latter (responses.shown_gloss).
        """
        packs = self._portion_packs(batch.surface.packs)
        room = self._room(packs)
        portions = list(self._portions(batch, band, visible, light.small, packs))
        new = [portion for portion in portions if _key(portion) not in self._ahead]
        with ThreadPoolExecutor(devices.worker_count(), thread_name_prefix="relit-model") as pool:
            for portion, facing in zip(new, pool.map(self._facing, new), strict=True):
                self._ahead[_key(portion)] = (wp.array(facing, dtype=wp.int32, device=self._model.device),
                                              upload_sources(self._grid.taken(facing), self._model.device))
        for portion in portions:
            numbers, sources = self._ahead[_key(portion)]
            use(portion, numbers, *self._responses(portion, sources, *room, scale))

    def _room(self, packs: int) -> tuple[Responses, Responses]:
        """Return memory for the responses of a portion to the grid and to the captured lights."""
        device = self._model.device
        return empty_responses(self._grid.count, packs, device), empty_responses(len(self._captured.place), packs, device)

    def _facing(self, portion: Portion) -> np.ndarray:
        """Return the numbers of the directions of the grid that light any pixel of a portion; the responses to all others are 0."""
        return facing_directions(self._towards, self._model.normals(portion.position))

    def _portion_packs(self, packs: int) -> int:
        """Return how many packs a portion of a batch has, at most."""
        device = self._model.device
        pack_bytes = 4 * 4 * devices.pack_width(device) * self._grid.count
        if device == "cpu":
            return max(1, RESPONSE_BYTES // pack_bytes)
        return max(1, min(devices.batch_bytes(device, CUDA_RESPONSE_BYTES) // pack_bytes, -(-packs // CUDA_PORTIONS)))

    def _portions(self, batch: ModelBatch, band: Band, visible: wp.array, small: Sequence[SmallLights], step: int) -> Iterator[Portion]:
        """Cut a batch into portions of `step` packs."""
        pack, count = devices.pack_width(self._model.device), len(batch.pixels)
        horizons = [self._model.horizons(each.direction, batch) if len(each.direction) else None for each in small]
        for first in range(0, batch.surface.packs, step):
            packs = slice(first, min(first + step, batch.surface.packs))
            pixels = slice(first * pack, min(packs.stop * pack, count))
            size = pixels.stop - pixels.start
            surface = batch.surface._replace(values=batch.surface.values[:, packs], pixel_count=size)
            images = band._replace(values=band.values[:, packs], saturated=band.saturated[:, packs], pixel_count=size)
            yield Portion(pixels, surface, images, visible[:, packs],
                          tuple(None if each is None else each._replace(tangent=each.tangent[:, packs]) for each in horizons),
                          batch.pixels[pixels])

    def _responses(self, portion: Portion, sources: SourcesOnDevice, grid_room: Responses, captured_room: Responses,
                   scale: np.ndarray) -> tuple[Responses, Responses, wp.array]:
        """Return the responses of a portion to directions of the grid and to the captured lights, in memory that is given, and the gloss
        that the images show under these."""
        grid = grid_room.room(len(sources.place), portion.surface.packs)
        captured = captured_room.room(len(self._captured.place), portion.surface.packs)
        respond(portion.surface, sources, portion.visible, grid)
        respond(portion.surface, self._captured, portion.visible, captured)
        images = Captured.of(portion.band, portion.surface, portion.visible, self._lights.direction, self._lights.irradiance, scale)
        return grid, captured, shown_gloss(images, captured)


def _key(portion: Portion) -> tuple[int, int]:
    """Return the first position and the number of the pixels of a portion, which tell it from all others."""
    return int(portion.position[0]), len(portion.position)


def correction(model: LitModel, plain: np.ndarray, trust: np.ndarray, trust_beyond: np.ndarray | None,
               least: float) -> tuple[np.ndarray, np.ndarray]:
    """Return what is added to frames, and the model's specular part of their light.

    Args:
        plain: [3, n] or [frames, 3, n] sums of captured images.
        trust: [n] β between the captured lights.
        trust_beyond: [n] β beyond them; not None where the model has such light.
        least: the least β of what is taken away there.
    """
    mirror = model.gloss * model.ratio
    picture = np.maximum(model.whole, 0)  # what the model has in place of the sums
    if model.added is not None:
        picture = picture + model.added.sum(axis=-3)
    if model.beyond is not None:
        picture = picture + model.beyond.captured
    # what images have lost by a shadow that the model has elsewhere is not taken from them a second time
    change = trust * followed(model.matt + mirror - model.whole, np.minimum(plain, picture), picture)
    if model.beyond is not None and trust_beyond is not None:
        change = change + trusted(followed(model.beyond.whole - model.beyond.captured, plain, picture), trust_beyond, least)
        mirror = mirror + model.beyond.gloss
    if model.added is not None:
        mirror = mirror + model.added[..., 1, :, :]
    return change, mirror


def _summed(portion: Portion, albedo: np.ndarray, grid: Responses, facing: np.ndarray, captured: Responses, shown: wp.array,
            light: ChunkLight) -> LitModel:
    """Return the model of a portion under the light of frames, from its responses to the directions of the grid that are `facing`."""
    count = albedo.shape[1]
    energy, broad = light.captured, light.broad.at(facing)
    matt, gloss = broad.matt(grid, albedo), broad.gloss(grid.gloss, count)
    for lights, horizons in zip(light.small, portion.horizons, strict=True):
        if horizons is not None:
            visible = see_above(lights.direction, portion.surface, horizons)
            small = to_numpy(shade_frames(portion.surface, lights.sources, visible))[..., :count].reshape(-1, 2, 3, count)
            matt[lights.frames] += small[:, 0]
            gloss[lights.frames] += small[:, 1]
    positive = energy._replace(weights=np.maximum(energy.weights, 0))
    ratio = ratio_of_sums(positive.gloss(shown, count), positive.gloss(captured.gloss, count))
    added = beyond = None
    if light.added is not None:
        added = np.stack([light.added.matt(captured, albedo), light.added.gloss(captured.gloss, count)], axis=1)
    if light.beyond is not None:
        outside = light.beyond.broad.at(facing)
        shine = outside.gloss(grid.gloss, count)
        whole = outside.matt(grid, albedo) + shine
        small = to_numpy(shade_frames(portion.surface, light.beyond.small, portion.visible))[..., :count].reshape(-1, 2, 3, count)
        stands_in = light.beyond.captured.matt(captured, albedo) + light.beyond.captured.gloss(captured.gloss, count)
        beyond = LitBeyond(whole + small.sum(axis=1), shine + small[:, 1], stands_in)
    return LitModel(matt, gloss, energy.matt(captured, albedo) + energy.gloss(shown, count), ratio, added, beyond)
