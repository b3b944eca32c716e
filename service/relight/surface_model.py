"""Solved maps as a surface that can be lit: its pixels in batches on a device, and which lights they see over its height.

The surface reflects by Relit's BRDF, Lambert and the GGX lobes of one material or two (kernels.relight.model.shading cites its equations).
"""

from collections.abc import Iterable, Iterator
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np
import warp as wp

from kernels import device as devices
from kernels import packs
from kernels.device import to_numpy
from kernels.packs import Band
from kernels.relight.model.shading import PLANES, SecondLobe, Surface, shade, upload_surface
from kernels.relight.model.sources import Sources
from kernels.relight.shadows.horizon import HeightField, Horizons, azimuths_of, find_horizons, height_field
from kernels.relight.shadows.occlusion import see_lights
from kernels.surface.shadows import extent_of
from service.relight.footprint import NARROW, places_within, turns_within
from service.solve.base.batches import view_directions
from service.solve.height.height import projection_of
from service.solve.height.thickness import guess_thickness
from stage.errors import ResultError
from stage.results.maps import LOBES, SurfaceMaps

BATCH_PIXELS = 1 << 17
"""Number of pixels that are lit at one time: 8 MB of maps, and a byte for each pixel and light whose visibility is kept."""
CUDA_BATCH_PIXELS = 1 << 19
"""The same on CUDA, where each batch is some hundred launches: with 96 lights 0.4 GB, and of a thousand lights no more values than 32
bits count."""
KEPT_BYTES = 1 << 30
"""Most bytes, on a device with much memory more, of what is kept between chunks of frames: the surface on CUDA, and the visibility of the
captured lights. For larger pictures they are made again."""
NORMAL_CELLS = 32
"""Number of cells, a power of two, along each side of the square of normals that face the viewer: a cell is some 5° wide."""


class ModelBatch(NamedTuple):
    """Some pixels of the surface on the device."""

    part: slice
    """Where its pixels are among those of the model."""
    pixels: np.ndarray  # [n] row-major positions in the image
    surface: Surface
    profile: np.ndarray | None  # [n, 3] of the specular part; None: that of the BRDF


class Lobes(NamedTuple):
    """The specular lobes of some pixels."""

    specular: np.ndarray  # [n, 3] F0 of the first
    roughness: np.ndarray  # [n, 1] of the first
    second: SecondLobe | None

    @property
    def narrowest(self) -> np.ndarray:
        """[n] Width α of the narrowest lobe of each pixel; infinite where there is none."""
        widths = [np.where(self.specular.max(axis=1) > 0, self.roughness[:, 0] ** 2, np.inf)]
        if self.second is not None:
            widths.append(np.where(self.second.share[:, 0] > 0, self.second.roughness[:, 0] ** 2, np.inf))
        return np.min(widths, axis=0)


class Portion(NamedTuple):
    """Neighbouring packs of a batch."""

    pixels: slice
    """The pixels of the batch that the portion covers."""
    surface: Surface
    band: Band
    visible: wp.array  # [lights, P] of the captured lights
    horizons: tuple[Horizons | None, ...]
    """Horizons for each group of small lights; None where it has none."""
    position: np.ndarray  # [n] row-major positions in the image


class SurfaceModel:
    """A surface that can be lit."""

    def __init__(self, maps: SurfaceMaps, where: Path, device: str, *, chosen: np.ndarray | None = None, by_normal: bool = False) -> None:
        """Keep solved maps for lighting.

        Args:
            maps: with normal, diffuse albedo and height; without specular and roughness there is no specular lobe, and where abundance
                is above 0 there are those of two materials.
            where: their file, for messages.
            chosen: [rows, cols] bool, the pixels that will be lit; the others only cast shadows. None: all.
            by_normal: True to make pixels of like normals neighbours within each batch; else pixels ascend.
        """
        for name in ("normal", "diffuse_albedo", "height"):
            if getattr(maps, name) is None:
                raise ResultError(f"{where}: has no layer {name}, which lighting the maps needs: solve with lambert, robust or svbrdf")
        if maps.abundance is not None and (lacking := [name for lobe in LOBES for name in lobe if getattr(maps, name) is None]):
            raise ResultError(f"{where}: has a layer abundance and no layer {lacking[0]}, which pixels of two materials need: solve again")
        assert maps.normal is not None and maps.diffuse_albedo is not None and maps.height is not None
        self.maps, self.device = maps, device
        normal = maps.normal.reshape(-1, 3)
        whole = maps.mask.reshape(-1) & np.isfinite(maps.height).reshape(-1) & (np.abs(normal).sum(axis=1) > 0)
        pixels = np.flatnonzero(whole if chosen is None else whole & chosen.reshape(-1))
        self._batch_pixels = BATCH_PIXELS if device == "cpu" else CUDA_BATCH_PIXELS
        self.pixels = _by_normal(pixels, normal, self._batch_pixels) if by_normal else pixels
        """[n] Row-major positions of the solved pixels that will be lit."""
        if not len(self.pixels):
            raise ResultError(f"{where}: no pixel is solved")
        self.middle = self.places(self.pixels).mean(axis=0)
        """[3] Mean place of these pixels."""
        self._view = view_directions(maps.camera)
        inside = self._inside = whole.reshape(maps.mask.shape)
        self._part = np.zeros(inside.shape, np.uint8) if maps.part is None else maps.part
        self._height = wp.array(np.where(inside, maps.height, 0).astype(np.float32), dtype=wp.float32, device=device)
        self._mask = wp.array(np.where(inside, np.maximum(1, self._part), 0).astype(np.uint8), dtype=wp.uint8, device=device)
        self._projection = projection_of(maps.camera)
        self._extent = extent_of(np.where(inside, maps.height, 0), inside)
        self._thickness = self._guessed_thickness() if len(np.unique(self._part[inside])) > 1 else None
        self.profile: np.ndarray | None = None
        """[n, 3] Profile of the specular part at the solved pixels (kernels.relight.model.lobe_profile); None: that of the BRDF."""
        self._keep = device != "cpu" and 4 * PLANES * len(self.pixels) <= devices.batch_bytes(device, KEPT_BYTES)
        self._kept: tuple[np.ndarray | None, list[ModelBatch]] | None = None

    def batches(self) -> Iterable[ModelBatch]:
        """Return the solved pixels in batches, which a CUDA device keeps until the profile is another."""
        if not self._keep:
            return self._made()
        if self._kept is None or self._kept[0] is not self.profile:
            self._kept = self.profile, list(self._made())
        return self._kept[1]

    @cached_property
    def positions(self) -> wp.array:
        """Return `pixels` on the device, int32."""
        return wp.array(self.pixels, dtype=wp.int32, device=self.device)

    def _made(self) -> Iterator[ModelBatch]:
        for start in range(0, len(self.pixels), self._batch_pixels):
            part = slice(start, min(start + self._batch_pixels, len(self.pixels)))
            pixels, profile = self.pixels[part], None if self.profile is None else self.profile[part]
            yield ModelBatch(part, pixels, self._surface(pixels, self.normals(pixels), self.places(pixels), profile), profile)

    def _surface(self, pixels: np.ndarray, normal: np.ndarray, places: np.ndarray, profile: np.ndarray | None) -> Surface:
        """Put pixels on the device, with these normals and places."""
        lobes, maps = self._lobes(pixels), self.maps
        assert maps.diffuse_albedo is not None
        return upload_surface(normal, self._rows(maps.diffuse_albedo, pixels), lobes.specular, lobes.roughness, self._view(pixels),
                              places, second=lobes.second, profile=profile, device=self.device)

    def _rows(self, values: np.ndarray, pixels: np.ndarray) -> np.ndarray:
        return values.reshape(self.maps.mask.size, -1)[pixels].astype(np.float32, copy=False)

    def _lobes(self, pixels: np.ndarray) -> Lobes:
        """Return the specular lobes of pixels."""
        maps = self.maps
        specular, roughness = np.zeros((len(pixels), 3), np.float32), np.zeros((len(pixels), 1), np.float32)
        if maps.specular is not None and maps.roughness is not None:
            specular, roughness = self._rows(maps.specular, pixels), self._rows(maps.roughness, pixels)
            specular = np.maximum(specular, 0)  # maps of relit 0.2.0 or of other programs may be a little below
        if maps.abundance is None:
            return Lobes(specular, roughness, None)
        layers = (maps.first_specular, maps.first_roughness, maps.second_specular, maps.second_roughness)
        first_specular, first_roughness, *other = (self._rows(layer, pixels) for layer in layers if layer is not None)
        abundance = self._rows(maps.abundance, pixels)
        return Lobes(np.where(abundance > 0, first_specular, specular), np.where(abundance > 0, first_roughness, roughness),
                     SecondLobe(*other, np.where(abundance > 0, 1 - abundance, 0)))

    def lit(self, batch: ModelBatch, light: Sources, visible: wp.array) -> np.ndarray:
        """Return the radiance of a batch under samples of light: [6, n] float32, diffuse RGB and specular RGB.

        Pixels whose normals turn too much for their lobe (service.relight.footprint) have the mean of several places within them.
        `visible` is that of `see`.
        """
        assert self.maps.normal is not None
        count = len(batch.pixels)
        lit = to_numpy(shade(batch.surface, light, visible))[:, :count]
        turns = turns_within(batch.pixels, self.normals, self.maps.normal, self._inside, self._part)
        narrow = np.flatnonzero((turns**2).sum(axis=(0, 2)) > (NARROW * self._lobes(batch.pixels).narrowest) ** 2)
        if not len(narrow):
            return lit
        pixels, profile = batch.pixels[narrow], None if batch.profile is None else batch.profile[narrow]
        normal, place, turned = self.normals(pixels), self.places(pixels), turns[:, narrow]
        moved = turns_within(pixels, self.places, self.maps.normal, self._inside, self._part)
        seen = packs.zeros(len(narrow), wp.uint8, self.device, rows=visible.shape[0])
        packs.take_columns(packs.as_pixels(visible), wp.array(narrow, dtype=wp.int32, device=self.device), 0, seen)
        within = []
        for along, down in places_within():
            turning = normal + along * turned[0] + down * turned[1]
            turning /= np.maximum(np.linalg.norm(turning, axis=1, keepdims=True), 1e-6)
            surface = self._surface(pixels, turning, place + along * moved[0] + down * moved[1], profile)
            within.append(to_numpy(shade(surface, light, packs.as_packs(seen, self.device)))[:, : len(narrow)])
        lit[:, narrow] = np.mean(within, axis=0)
        return lit

    def places(self, pixels: np.ndarray) -> np.ndarray:
        """Return the places of pixels [n], row-major positions: [n, 3] float32, camera frame."""
        assert self.maps.height is not None
        return self.maps.camera.points_at(pixels, self.maps.height.reshape(-1)[pixels])

    def see(self, place: np.ndarray, batch: ModelBatch) -> wp.array:
        """Return which pixels of a batch see which lights, as [n, P] uint8 packs of 255 or 0; those that do not face a light, 255.
        `place`: [n, 4] direction and 0, or position and 1."""
        return see_lights(place, batch.pixels, self._height, self._mask, self._projection, extent=self._extent, thickness=self._thickness,
                          surface=batch.surface, device=self.device)

    def _guessed_thickness(self) -> wp.array:
        """Return how thick the parts are taken to be, on the device."""
        assert self.maps.height is not None
        pixels, perspective = np.flatnonzero(self._inside), self._projection.perspective
        facing, height = np.zeros(self._inside.size), np.where(self._inside, self.maps.height, -1).astype(np.float64)
        facing[pixels] = (self.normals(pixels) * self._view(pixels)).sum(axis=1)
        pixel = 2 / float(self._projection.scale[0] + self._projection.scale[1])
        thickness = guess_thickness(-np.log(-height) if perspective else height, np.where(self._inside, self._part.astype(int), -1),
                                    facing.reshape(height.shape), pixel)
        return wp.array((thickness * -height if perspective else thickness).astype(np.float32), dtype=wp.float32, device=self.device)

    def normals(self, pixels: np.ndarray) -> np.ndarray:
        """Return [m, 3] float32 normals of pixels [m]."""
        assert self.maps.normal is not None
        return self.maps.normal.reshape(-1, 3)[pixels].astype(np.float32, copy=False)

    def albedo(self, pixels: np.ndarray) -> np.ndarray:
        """Return [3, m] float32 diffuse albedo of pixels [m]."""
        assert self.maps.diffuse_albedo is not None
        return np.ascontiguousarray(self.maps.diffuse_albedo.reshape(-1, 3)[pixels].T, dtype=np.float32)

    def horizons(self, direction: np.ndarray, batch: ModelBatch) -> Horizons:
        """Return the horizons of a batch, as far as they tell which pixels see far lights in directions [n, 3]."""
        sight = np.zeros((1, 2))
        if self._projection.perspective:
            points = self.places(batch.pixels)
            sight = points[:, :2] / points[:, 2:]
        return find_horizons(azimuths_of(direction, sight), batch.pixels, batch.surface, self._field)

    @cached_property
    def _field(self) -> HeightField:
        """The height on the device, for finding horizons."""
        return height_field(to_numpy(self._height), to_numpy(self._mask) != 0, self._projection, self.device)


def _by_normal(pixels: np.ndarray, normal: np.ndarray, count: int) -> np.ndarray:
    """Return the pixels [n] of each batch of `count` sorted by the cell of their normal, the cells in Morton order: a far light leaves
    neighbours dark together (service.relight.model_range)."""
    ordered = []
    for start in range(0, len(pixels), count):
        batch = pixels[start : start + count]
        x, y, z = normal[batch].T
        equal_area = np.stack([x, y]) / np.sqrt(np.maximum(1 + z, 1e-3))  # -1…1 where z is 0 or above
        cell = np.clip((equal_area + 1) / 2 * NORMAL_CELLS, 0, NORMAL_CELLS - 1).astype(np.int32)
        place = np.zeros(len(batch), dtype=np.int32)
        for bit in range(NORMAL_CELLS.bit_length() - 1):
            place |= ((cell[0] >> bit & 1) << (2 * bit)) | ((cell[1] >> bit & 1) << (2 * bit + 1))
        ordered.append(batch[np.argsort(place, kind="stable")])
    return np.concatenate(ordered) if ordered else pixels
