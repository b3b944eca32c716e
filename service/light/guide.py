"""Model-guided relighting: what a model of the surface says the plain sum of captured images misses is added, as far as it can be trusted.

frame = Σ w_i I_i + β · (model under the wanted light − Σ w_i · model under captured light i). The captured images bring shadows,
interreflection and scattering, the model brings what lies between the lights: sharp lobes, and the shadows of small bright lights. β of
each pixel comes from the captured lights themselves (kernels.relight.guide).
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import warp as wp

from kernels import packs
from kernels.errors import ArrayError
from kernels.relight.around import left_out
from kernels.relight.guide import compare_model, fit_trust, seen_lobes
from kernels.relight.near_sum import sum_near
from kernels.relight.shading import shade
from service.light.environments import Environments
from service.light.model_light import LightModel
from service.light.near_light import NearLight, near_lights
from service.light.schedule import FrameLighting
from service.light.surface_model import ModelBatch, SurfaceModel
from service.reporting.progress import Timings
from stage.errors import ResultError
from stage.maps import SurfaceMaps
from stage.point_lights import DistantLights
from stage.stack import Stack

NOTHING = np.zeros((0, 4), dtype=np.float32)
KEPT_BYTES = 1 << 30
"""Of what pixels see of the captured lights, that is kept between chunks; of larger pictures it is marched anew."""


class Guide:
    """A model of one capture's surface, and how far each pixel trusts it."""

    def __init__(self, model: SurfaceModel, stack: Stack, lights: DistantLights, light: LightModel, progress: Timings | None) -> None:
        """Look at every captured light from every pixel, and fit β.

        Args:
            model: of the surface.
            stack: the captured images.
            lights: that lit them.
            light: makes the light of frames.
            progress: told of every batch.

        Raises:
            ArrayError: fewer than four lights, or all in one plane.
        """
        self._model, self._lights, self._light, self._stack = model, lights, light, stack
        self._place = np.concatenate([lights.direction, np.zeros((len(lights.direction), 1))], axis=1)
        self._keep = len(self._place) * len(model.pixels) <= KEPT_BYTES
        self._seen: dict[int, wp.array] = {}
        neighbours, shares = left_out(lights.direction)
        if progress is not None:
            progress.stage("guide", len(model.pixels))
        sums, done = np.zeros((2, len(model.pixels)), dtype=np.float32), 0
        for batch in model.batches():
            band = packs.upload(*stack.pick(batch.pixels), device=model.device)
            compared = compare_model(band, batch.surface, self._visible(batch), lights.direction, lights.irradiance, stack.scale,
                                     neighbours, shares)
            sums[:, done : done + len(batch.pixels)] = compared.numpy()[:, : len(batch.pixels)]
            done += len(batch.pixels)
            if progress is not None:
                progress.advance(done)
        self.trust = fit_trust(sums, model.pixels, model.maps.mask.shape)
        """[n] β of the model's pixels, 0…1."""

    def correct(self, frames: np.ndarray, lighting: Sequence[FrameLighting], weights: np.ndarray, *,
                specular: bool) -> np.ndarray | None:
        """Add to plain frames what the model says they miss.

        Args:
            frames: [frames, 3, pixels] float32, changed in place; never below 0 where they were not.
            lighting: of each.
            weights: [frames, 3, lights padded] of the stored images in each.
            specular: whether the specular part is wanted by itself.

        Returns:
            [frames, 3, pixels] float32 of that part, between 0 and the frame, or None.
        """
        light = [self._light.light(frame, self._energy(frame, each)) for frame, each in zip(lighting, weights, strict=True)]
        shine = np.zeros(frames.shape, dtype=np.float32) if specular else None
        done = 0
        for batch in self._model.batches():
            count = len(batch.pixels)
            trust = self.trust[done : done + count]
            for index, lit in enumerate(light):
                visible = self._visible(batch, lit.marched)
                wanted = shade(batch.surface, lit.wanted, visible).numpy()[:, :count]
                given = shade(batch.surface, lit.captured, visible).numpy()[:, :count]
                plain = frames[index][:, batch.pixels]
                guided = np.maximum(plain + trust * (wanted - given).reshape(2, 3, count).sum(axis=0), np.minimum(plain, 0))
                frames[index][:, batch.pixels] = guided
                if shine is not None:
                    whole = self._whole_shine(batch, lighting[index], wanted, visible)
                    shine[index][:, batch.pixels] = np.clip(whole, 0, np.maximum(guided, 0))
            done += count
        return shine

    def add_near(self, frame: np.ndarray, shine: np.ndarray, lights: Sequence[NearLight]) -> None:
        """Add near lights to a frame: every pixel's own sum of the captured images, and what the model says that misses.

        Args:
            frame: [3, pixels] float32, changed in place.
            shine: [3, pixels] float32, its specular part, changed in place.
            lights: in the camera frame.
        """
        near = near_lights(lights, len(self._place))
        if not near.fine.count:
            return
        done = 0
        for batch in self._model.batches():
            count = len(batch.pixels)
            visible = self._visible(batch, near.marched)
            wanted = shade(batch.surface, near.fine, visible).numpy()[:, :count]
            band = packs.upload(*self._stack.pick(batch.pixels), device=self._model.device)
            summed = sum_near(band, batch.surface, visible, near.coarse, self._lights.direction, self._lights.irradiance,
                              self._stack.scale).numpy()[:, :count]
            missing = wanted[:3] + wanted[3:] - summed[3:]
            added = np.maximum(summed[:3] + self.trust[done : done + count] * missing, 0)
            frame[:, batch.pixels] += added
            shine[:, batch.pixels] += np.clip(wanted[3:], 0, added)
            done += count

    def _energy(self, lighting: FrameLighting, weights: np.ndarray) -> np.ndarray:
        """[lights, 3] that map and discs give each captured light: what its weight stands for beside `captured` of the frame."""
        count = len(self._lights.direction)
        scale = np.asarray(self._stack.scale[:count], dtype=np.float64)
        shares = np.divide(weights[:, :count].T, scale[:, None], out=np.zeros((count, 3)), where=scale[:, None] > 0)
        for image, weight in lighting.captured.items():
            shares[self._stack.frames.index(image)] -= weight
        return shares * self._lights.irradiance

    def _whole_shine(self, batch: ModelBatch, lighting: FrameLighting, wanted: np.ndarray, visible: wp.array) -> np.ndarray:
        """[3, n] specular part under everything, captured images that the frame adds included."""
        whole = wanted[3:].copy()
        if lighting.captured:
            energy = np.zeros((len(self._lights.direction), 3))
            for image, weight in lighting.captured.items():
                light = self._stack.frames.index(image)
                energy[light] += weight * self._lights.irradiance[light]
            whole += shade(batch.surface, self._light.captured(energy), visible).numpy()[3:, : whole.shape[1]]
        return whole

    def _visible(self, batch: ModelBatch, marched: np.ndarray = NOTHING) -> wp.array:
        """What the pixels see of the captured lights, and of further places."""
        first = int(batch.pixels[0])
        seen = self._seen.get(first)
        if seen is None:
            seen = self._model.see(self._place, batch.pixels)
            if self._keep:
                self._seen[first] = seen
        if not len(marched):
            return seen
        both = wp.empty((seen.shape[0] + len(marched), seen.shape[1]), dtype=seen.dtype, device=self._model.device)
        wp.copy(both, seen, count=seen.size)
        wp.copy(both, self._model.see(marched, batch.pixels), dest_offset=seen.size)
        return both


def make_guide(maps: SurfaceMaps, where: Path, stack: Stack, lights: DistantLights, environments: Environments | None, space: str,
               device: str, progress: Timings | None) -> Guide:
    """A guide from solved maps.

    Args:
        maps: of the capture, in its working space.
        where: their file, for messages.
        stack, lights: of the capture.
        environments: that maps of frames are read from.
        space: scene-linear, of the stack.
        device: where.
        progress: told of every batch.

    Raises:
        ResultError: maps of other images or another colour space, without the layers that a model needs; fewer than four lights,
            or all in one plane.
    """
    if maps.provenance.get("relit:inputs", stack.key) != stack.key:
        raise ResultError(f"{where}: was solved from other images than the capture has: solve it again")
    if maps.color_space != space:
        raise ResultError(f"{where}: is in {maps.color_space}, the capture in {space}: solve it again")
    if maps.specular is not None and maps.roughness is not None:
        specular, roughness = seen_lobes(maps.specular, maps.roughness, lights.direction)
        maps = replace(maps, specular=specular, roughness=roughness)
    try:
        light = LightModel(lights, environments, space)
    except ArrayError as error:
        raise ResultError(f"{where}: cannot guide this capture: a model helps between four lights or more that are not all in one "
                          "plane") from error
    return Guide(SurfaceModel(maps, where, device), stack, lights, light, progress)
