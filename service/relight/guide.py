"""Model-guided relighting: what a model of the surface says the plain sum of captured images misses is added, as far as it can be trusted.

frame = Σ w_i I_i + β · (model under the wanted light − Σ w_i · model under captured light i). The captured images bring shadows,
interreflection and scattering, the model brings what lies between the lights: sharp lobes, and the shadows of small bright lights. The
lobes are first refined to what the captured images show of them (kernels.relight.model.lobe_profile), and what is still missing of a
highlight is a ratio, not a difference (kernels.relight.model.gloss_ratio). β of each pixel is fitted to the captured images
(kernels.relight.model.guide). Light from beyond the captured lights has a β of its own, and what the model takes away there is a share of
the sum (kernels.relight.model.beyond).

Source: a control variate with a regression coefficient, Glasserman, "Monte Carlo Methods in Financial Engineering", section 4.1.
"""

from collections.abc import Callable, Sequence
from functools import cached_property, partial
from pathlib import Path

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.device import to_numpy
from kernels.errors import ArrayError
from kernels.images import ImagesOnDevice
from kernels.packs import Band
from kernels.relight.frames.halves import to_halves
from kernels.relight.frames.near_sum import sum_near
from kernels.relight.model.beyond import compare_beyond, followed, inward_pairs, share_beyond, trusted
from kernels.relight.model.captured import Captured
from kernels.relight.model.gloss_ratio import sum_shown
from kernels.relight.model.guide import compare_model, fit_trust, seen_lobes
from kernels.relight.model.guided import FramesOnDevice, Pixels
from kernels.relight.model.lobe_profile import MOMENTS, fit_profile, profile_moments
from kernels.relight.model.responses import Responses
from kernels.relight.model.shading import shade
from kernels.relight.model.sources import Sources
from service.relight.clipping import Clipping, clipped_channels
from service.relight.combine import frames_on_device
from service.relight.far_light import captured_lights
from service.relight.model_light import ModelLight, NearLights
from service.relight.model_range import LitBeyond, LitModel, ModelRange, correction
from service.relight.range_light import LightOnDevice, RangeLight
from service.relight.surface_model import KEPT_BYTES, ModelBatch, Portion, SurfaceModel
from service.relight.weights.triangulation import left_out, triangles_between
from service.reporting.progress import Timings
from service.reporting.provenance import other_inputs
from stage.capture.point_lights import DistantLights
from stage.errors import ResultError
from stage.results.maps import SurfaceMaps
from stage.stack.stack import ReplacedStack, Stack

NOTHING = np.zeros((0, 4), dtype=np.float32)
"""An empty list of places to march to."""


class Guide:
    """A model of one capture's surface, and how far each pixel trusts it."""

    def __init__(self, maps: SurfaceMaps, where: Path, stack: Stack, lights: DistantLights, clipping: Clipping, *, space: str, device: str,
                 progress: Timings | None) -> None:
        """Compare the model with every captured image, fit β, and estimate the clipped readings.

        Args:
            where: the file of the maps, for messages.
            space: the scene-linear space of the stack, which must be that of the maps.

        Raises:
            ResultError: maps of other images or another colour space, or without the layers that a model needs; fewer than four
                lights, or all in one plane.
        """
        self.doubt = other_inputs(maps.provenance, stack.key, where)
        """The sentence for maps of another version, of which nothing tells whether they are of these images; None: they are."""
        if maps.color_space != space:
            raise ResultError(f"{where}: is in {maps.color_space}, the capture in {space}: solve it again")
        maps = maps.with_lobes(partial(seen_lobes, direction=lights.direction))
        try:
            neighbours, shares = left_out(lights.direction)
        except ArrayError as error:
            raise ResultError(f"{where}: cannot guide this capture: a model helps between four lights or more that are not all in one "
                              "plane") from error
        self._model, self._lights, self._recorded = SurfaceModel(maps, where, device, by_normal=True), lights, ImagesOnDevice(stack, device)
        self._place = np.concatenate([lights.direction, np.zeros((len(lights.direction), 1))], axis=1)
        self._keep = len(self._place) * len(self._model.pixels) <= devices.batch_bytes(device, KEPT_BYTES)
        self._seen: dict[int, wp.array] = {}
        if progress is not None:
            progress.stage("guide", 2 * len(self._model.pixels))
        moments = self._sums(MOMENTS, profile_moments, progress)
        self._model.profile = fit_profile(moments, self._model.pixels, maps.mask.shape)
        self.trust = self._fit(partial(compare_model, neighbours=neighbours, shares=shares), progress)
        """[n] β of the model's pixels between the captured lights, 0…1."""
        self.images = self._unclipped(clipping.level)
        """The captured images, with clipped readings as bright as the model has them."""

    @cached_property
    def trust_beyond(self) -> np.ndarray:
        """Return [n] β of the model's pixels for light from beyond the captured lights, 0…1."""
        return self._fit(partial(compare_beyond, pairs=inward_pairs(self._lights.direction)), None)

    @cached_property
    def least_beyond(self) -> float:
        """Return the least β of what the model takes away there: that of the median pixel."""
        return float(np.median(self.trust_beyond))

    def _fit(self, compare: Callable[[Captured], wp.array], progress: Timings | None) -> np.ndarray:
        """Return [n] β from sums [2, pixels] that a comparison takes of every batch."""
        return fit_trust(self._sums(2, compare, progress, before=len(self._model.pixels)), self._model.pixels, self._model.maps.mask.shape)

    def _sums(self, rows: int, take: Callable[[Captured], wp.array], progress: Timings | None, before: int = 0) -> np.ndarray:
        """Return [rows, n] float32 sums [rows, pixels padded] that are taken of every batch; `before`: steps of the progress until then."""
        sums = np.zeros((rows, len(self._model.pixels)), dtype=np.float32)
        for batch in self._model.batches():
            taken = take(self._captured(batch, self._recorded, self._visible(batch)))
            sums[:, batch.part] = to_numpy(taken)[:, : len(batch.pixels)]
            if progress is not None:
                progress.advance(before + batch.part.stop)
        return sums

    def _captured(self, batch: ModelBatch, images: ImagesOnDevice[Stack], visible: wp.array, band: Band | None = None) -> Captured:
        """Return the captured images of a batch beside the model; `band`, if they are on the device already."""
        return Captured.of(band or images.pick(batch.pixels), batch.surface, visible, self._lights.direction, self._lights.irradiance,
                           images.stack.scale)

    def _unclipped(self, level: np.ndarray) -> ImagesOnDevice[Stack]:
        """Return the captured images, where a reading is clipped at `level` [lights padded] and the model is brighter, by β brighter."""
        lights, stack, count = self._lights, self._recorded.stack, len(self._lights.direction)
        found: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
        for batch in self._model.batches():
            if not stack.pick_saturated(batch.pixels).any():
                continue
            values, bits = stack.pick(batch.pixels)
            channels = clipped_channels(values, bits, stack.scale, level)
            visible = self._visible(batch)
            for light in np.flatnonzero(channels[:, :count].any(axis=(0, 2))):
                alone = captured_lights(lights.direction, np.where(np.arange(count)[:, None] == light, lights.irradiance, 0))
                told = to_numpy(shade(batch.surface, alone, visible))[:, : len(batch.pixels)].reshape(2, 3, -1).sum(axis=0)
                read = values[:, light].astype(np.float32) * stack.scale[light]
                short = np.where(channels[:, light], np.maximum(told - read, 0), 0)
                at = np.flatnonzero(short.any(axis=0))
                found.append((batch.pixels[at], np.full(len(at), light), (read + self.trust[batch.part] * short)[:, at]))
        if not found:
            return self._recorded
        pixel, light, radiance = zip(*found, strict=True)
        return ImagesOnDevice(ReplacedStack.of(stack, np.concatenate(pixel), np.concatenate(light), np.concatenate(radiance, axis=1)),
                              self._model.device)

    def correct(self, frames: np.ndarray, lights: Sequence[ModelLight], *, specular: bool) -> np.ndarray | None:
        """Add to plain frames what the model says they miss, one frame after another.

        Args:
            frames: [frames, 3, pixels] float32, changed in place; never below 0 where they were not.
            lights: the light of each frame.
            specular: whether [frames, 3, pixels] float32 of that part, between 0 and the frame, is returned.
        """
        mirrored = np.zeros(frames.shape, dtype=np.float32) if specular else None
        for batch in self._model.batches():
            band = self.images.pick(batch.pixels)
            for index, light in enumerate(lights):
                frame, mirror = frames[index : index + 1], None if mirrored is None else mirrored[index : index + 1]
                self._add(frame, mirror, batch.pixels, batch.part, self._lit(batch, band, light))
        return mirrored

    def correct_range(self, frames: np.ndarray, lights: Sequence[RangeLight], places: Sequence[int], *,
                      specular: bool) -> np.ndarray | None:
        """Add to the plain frames of a chunk what the model says they miss; what they have in common is computed once.

        Args:
            frames, lights, specular: as for `correct`.
            places: position of each frame in the full chunk, also when only some of its frames are made.
        """
        mirrored = np.zeros(frames.shape, dtype=np.float32) if specular else None
        chunk = self._range.chunk(lights, places)
        if chunk.beyond is not None:
            _ = self.least_beyond  # before several threads ask for it
        for batch in self._model.batches():
            band = self.images.pick(batch.pixels)

            def use(at: slice, lit: LitModel, batch: ModelBatch = batch) -> None:
                first = batch.part.start
                self._add(frames, mirrored, batch.pixels[at], slice(first + at.start, first + at.stop), lit)

            self._range.light(batch, band, self.images.stack.scale, self._visible(batch), chunk, use)
        return mirrored

    def frames_on_device(self, weights: np.ndarray, lights: Sequence[RangeLight], places: Sequence[int], *,
                         specular: bool, halves: bool) -> tuple[np.ndarray, np.ndarray | None]:
        """Return the plain frames of a chunk with what the model says they miss, made on CUDA and downloaded once, and their specular part.

        Args:
            weights: of the frames, as for combine.linear_frames.
            lights, places, specular: as for `correct_range`.
            halves: whether the frames are half, as `to_halves` makes them; not where the specular part is wanted.
        """
        device, count = self._model.device, self.images.stack.pixel_count
        radiance = frames_on_device(self.images, weights, places)
        mirrored = wp.zeros((radiance.shape[0] if specular else 0, *radiance.shape[1:]), dtype=wp.float32, device=device)
        light = LightOnDevice(self._range.chunk(lights, places), FramesOnDevice(radiance, mirrored), places)
        trust = self._trust_on_device
        beyond = wp.empty(0, dtype=wp.float32, device=device) if light.chunk.beyond is None else self._trust_beyond_on_device
        for batch in self._model.batches():
            def use(portion: Portion, facing: wp.array, grid: Responses, captured: Responses, shown: wp.array,
                    first: int = batch.part.start) -> None:
                part = slice(first + portion.pixels.start, first + portion.pixels.stop)
                pixels = Pixels(portion.surface.values, self._model.positions[part], trust[part],
                                *((beyond[part], self.least_beyond) if len(beyond) else (beyond, 0.0)))
                light.correct(portion, pixels, facing, grid, captured, shown)

            self._range.light_on_device(batch, self.images.pick(batch.pixels), self.images.stack.scale, self._visible(batch), light.chunk,
                                        use)
        if halves:
            return np.stack([to_numpy(to_halves(radiance[place])) for place in places])[..., :count], None
        frames, mirror = (to_numpy(each)[list(places) if len(each) else [], :, :count] for each in (radiance, mirrored))
        return frames, mirror if specular else None

    @cached_property
    def _trust_on_device(self) -> wp.array:
        return wp.array(self.trust, dtype=wp.float32, device=self._model.device)

    @cached_property
    def _trust_beyond_on_device(self) -> wp.array:
        return wp.array(self.trust_beyond, dtype=wp.float32, device=self._model.device)

    def _add(self, frames: np.ndarray, mirrored: np.ndarray | None, pixels: np.ndarray, part: slice, lit: LitModel) -> None:
        """Add the correction of some pixels to frames [frames, 3, pixels], and keep its specular part."""
        plain = frames[:, :, pixels]
        beyond = (None, 0.0) if lit.beyond is None else (self.trust_beyond[part], self.least_beyond)
        change, mirror = correction(lit, plain, self.trust[part], *beyond)
        guided = np.maximum(plain + change, np.minimum(plain, 0))
        frames[:, :, pixels] = guided
        if mirrored is not None:
            mirrored[:, :, pixels] = np.clip(mirror, 0, np.maximum(guided, 0))

    def _lit(self, batch: ModelBatch, band: Band, light: ModelLight) -> LitModel:
        """Return the model of a batch under the light of one frame."""
        visible = self._visible(batch, light.marched)

        def lit(sources: Sources) -> np.ndarray:
            return to_numpy(shade(batch.surface, sources, visible))[:, : len(batch.pixels)].reshape(2, 3, -1)

        wanted = lit(light.wanted)
        given = sum_shown(self._captured(batch, self.images, visible, band), light.captured)
        beyond = None
        if light.beyond is not None:
            outside = lit(light.beyond.wanted)
            beyond = LitBeyond(outside.sum(axis=0), outside[1], lit(light.beyond.captured).sum(axis=0))
        return LitModel(wanted[0], wanted[1], given.whole, given.ratio, None if light.added is None else lit(light.added), beyond)

    @cached_property
    def _range(self) -> ModelRange:
        """The model for many frames."""
        return ModelRange(self._model, self._lights)

    @property
    def places(self) -> np.ndarray:
        """[n, 3] Places of the surface in the camera frame."""
        return self._model.places(self._model.pixels)

    def add_near(self, frame: np.ndarray, specular: np.ndarray, near: NearLights) -> None:
        """Add near lights to a frame: every pixel's own sum of the captured images, and what the model says that misses.

        Args:
            frame: [3, pixels] float32, changed in place.
            specular: [3, pixels] float32, its specular part, changed in place.
            near: whose rows of visibility follow those of the captured lights.
        """
        if not near.fine.count:
            return
        fine, coarse = self._beyond(near.fine), self._beyond(near.coarse)
        for batch in self._model.batches():
            visible = self._visible(batch, near.marched)
            wanted, pictures, told = self._near_part(batch, visible, near.fine.scaled(1 - fine), near.coarse.scaled(1 - coarse))
            added = pictures + self.trust[batch.part] * followed(wanted.sum(axis=0) - told, np.minimum(pictures, told), told)
            mirror = wanted[1]
            if fine.any() or coarse.any():
                wanted, pictures, told = self._near_part(batch, visible, near.fine.scaled(fine), near.coarse.scaled(coarse))
                added = added + pictures + trusted(followed(wanted.sum(axis=0) - told, pictures, told), self.trust_beyond[batch.part],
                                                     self.least_beyond)
                mirror = mirror + wanted[1]
            added = np.maximum(added, 0)
            frame[:, batch.pixels] += added
            specular[:, batch.pixels] += np.clip(mirror, 0, added)

    def _beyond(self, sources: Sources) -> np.ndarray:
        """Return how far near samples lie beyond the captured lights, as the middle of the surface sees them."""
        towards = sources.place[:, :3] - sources.place[:, 3:] * self._model.middle
        return share_beyond(self._lights.direction, towards / np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-20))

    def _near_part(self, batch: ModelBatch, visible: wp.array, fine: Sources, coarse: Sources) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the model under near samples [2, 3, n], diffuse and specular, and the images and the model summed for them [3, n] each."""
        count = len(batch.pixels)
        wanted = to_numpy(shade(batch.surface, fine, visible))[:, :count].reshape(2, 3, -1)
        captured = self._captured(batch, self.images, visible)
        summed = sum_near(captured, coarse, triangles_between(self._lights.direction))
        pictures, told = to_numpy(summed)[:, :count].reshape(2, 3, -1)
        return wanted, pictures, told

    def _visible(self, batch: ModelBatch, marched: np.ndarray = NOTHING) -> wp.array:
        """Return which pixels see the captured lights, and the marched places [n, 4] after them."""
        first = int(batch.pixels[0])
        seen = self._seen.get(first)
        if seen is None:
            seen = self._model.see(self._place, batch)
            if self._keep:
                self._seen[first] = seen
        if not len(marched):
            return seen
        both = wp.empty((seen.shape[0] + len(marched), seen.shape[1]), dtype=seen.dtype, device=self._model.device)
        wp.copy(both, seen, count=seen.size)
        wp.copy(both, self._model.see(marched, batch), dest_offset=seen.size)
        return both
