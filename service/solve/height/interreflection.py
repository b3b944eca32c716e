"""The light that an object throws on itself, from its height and normals and from its own images.

The image is cut into square patches, which are small, because larger ones would average over the sides of a fold. Their radiance under
each light is measured, so that all bounces are in it, and form factors carry it from patch to patch (kernels/surface/interreflection.py).
The light that arrives is interpolated between patches and subtracted from the readings of each pixel
(kernels/photometric/shadows/bounce.py).

Source: Nayar, Ikeuchi and Kanade, "Shape from interreflections", IJCV 1991, section 3: on a Lambertian surface radiance is direct
radiance + ρ K radiance, with the form factors in K.
"""

import math
from typing import NamedTuple

import numpy as np
import warp as wp

from kernels.device import to_numpy
from kernels.photometric.lambertian.readings import Lights
from kernels.surface.interreflection import gather_light
from kernels.surface.shadows import Projection
from service.solve.base.solution import SolveInput
from service.solve.height.height import projection_of
from stage.stack.stack import Stack

PATCHES = 20_000
"""Most patches: each pixel of an object of some 140 pixels across, and the memory that their light takes (12 bytes a patch and light)."""
PIXELS_PER_PATCH = 9
"""Most pixels whose mean stands for the radiance of a patch."""
LEAST_COVER = 0.5
"""A patch counts where this part of it is solved."""
LEAST_FACING = 0.15
"""Cosine to the viewer below which a patch's true area is not trusted to grow."""


class ArrivingLight(NamedTuple):
    """The light that arrives at each patch of the image, to interpolate between patches."""

    light: "np.ndarray | wp.array"  # [patches, 3, lights] float32: radiance that albedo 1 sends on / irradiance of the light
    numbers: np.ndarray  # [rows, cols] int: the number of each patch; -1 where there is none
    side: int
    """Pixels along a side of a patch."""

    def at(self, rows: np.ndarray, cols: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the four patches around each of n pixels, [n, 4] int, and their bilinear shares, [n, 4] float32.

        A missing patch gives its share to the others; shares are 0 where no patch is near.
        """
        v, u = (rows + 0.5) / self.side - 0.5, (cols + 0.5) / self.side - 0.5
        r, c = np.floor(v).astype(int), np.floor(u).astype(int)
        corners, shares = [], []
        for down, right in ((0, 0), (0, 1), (1, 0), (1, 1)):
            rr, cc = np.clip(r + down, 0, self.numbers.shape[0] - 1), np.clip(c + right, 0, self.numbers.shape[1] - 1)
            patch = self.numbers[rr, cc]
            share = (1 - np.abs(v - (r + down))) * (1 - np.abs(u - (c + right)))
            corners.append(np.maximum(patch, 0))
            shares.append(np.where(patch >= 0, share, 0))
        total = np.sum(shares, axis=0)
        return np.stack(corners, axis=1), (np.stack(shares, axis=1) / np.maximum(total, 1e-6)[:, None]).astype(np.float32)

    def mean_at(self, rows: np.ndarray, cols: np.ndarray) -> np.ndarray:
        """Return the mean over all lights and channels of the light that arrives at n pixels, [n]."""
        corners, shares = self.at(rows, cols)
        return (np.asarray(self.light).mean(axis=(1, 2))[corners] * shares).sum(axis=1)


class Patches(NamedTuple):
    """Parts of a surface that send light to each other."""

    centres: np.ndarray  # [patches, 3] in the camera frame
    facing: np.ndarray  # [patches, 3] unit normals
    areas: np.ndarray  # [patches] in the square of the centres' unit
    cells: np.ndarray  # [patches, 2] int: row and column in the grid of patches
    radiance: np.ndarray  # [patches, 3, lights] float32: radiance / irradiance
    numbers: np.ndarray  # [rows, cols] int of the grid: the number of each patch; -1 where there is none
    side: int
    """Pixels along a side of a patch."""
    mask: wp.array  # [rows, cols] uint8 of the image, on the device: where their surface is

    def some(self, at: np.ndarray) -> "Patches":
        """Return some of these, by their numbers."""
        return self._replace(centres=self.centres[at], facing=self.facing[at], areas=self.areas[at], cells=self.cells[at],
                             radiance=self.radiance[at])

    def light_on(self, others: "Patches | None", height: wp.array, projection: Projection) -> np.ndarray:
        """Return the light of these that arrives at others, or at each of them where None, [patches, 3, lights] as of `ArrivingLight`.
        `height`: [rows, cols] float32 on the device."""
        light = gather_light(self.centres, self.facing, self.areas, self.cells, self.radiance.reshape(len(self.cells), -1), height,
                             self.mask, projection, device=str(height.device),
                             receivers=None if others is None else (others.centres, others.facing))
        return light.reshape(-1, *self.radiance.shape[1:])

    def arriving(self, height: wp.array, projection: Projection) -> ArrivingLight:
        """Return the light of these that arrives at each of them; parameters as of `light_on`."""
        return ArrivingLight(self.light_on(None, height, projection), self.numbers, self.side)


def arriving_light(given: SolveInput, lights: Lights, normal: np.ndarray, height: wp.array, solved: np.ndarray) -> ArrivingLight | None:
    """Return the light that the object throws on itself, or None when the solved pixels cover fewer than two patches.

    Args:
        normal: [3, pixels] float32.
        height: [rows, cols] float32 on the device.
    """
    patches = patches_of(given, lights, normal, height, solved)
    return None if patches is None else patches.arriving(height, projection_of(given.camera))


def patches_of(given: SolveInput, lights: Lights, normal: np.ndarray, height: wp.array, solved: np.ndarray) -> Patches | None:
    """Return the surface as patches, or None when it covers fewer than two; parameters as of `arriving_light`."""
    camera, projection = given.camera, projection_of(given.camera)
    rows, cols = solved.shape
    perspective = camera.projection == "perspective"
    places = to_numpy(height)
    if perspective:  # a pixel without height would stand at the camera
        solved = solved & (places != 0)
    side = max(1, math.ceil(math.sqrt(solved.sum() / PATCHES)))
    shape = (-(-rows // side), -(-cols // side))
    pixels = np.flatnonzero(solved)
    patch = (pixels // cols // side) * shape[1] + pixels % cols // side
    count = np.bincount(patch, minlength=shape[0] * shape[1])
    kept = np.flatnonzero(count >= LEAST_COVER * side * side)
    if len(kept) < 2:
        return None
    number = np.full(len(count), -1)
    number[kept] = np.arange(len(kept))
    inside = number[patch] >= 0
    pixels, patch = pixels[inside], number[patch[inside]]

    def mean(values: np.ndarray) -> np.ndarray:
        sums = np.stack([np.bincount(patch, weights=plane, minlength=len(kept)) for plane in values.T], axis=1)
        return sums / count[kept][:, None]

    surface = camera.points(places).reshape(-1, 3)[pixels]
    centres, facing = mean(surface), mean(normal[:, pixels].T)
    facing /= np.maximum(np.linalg.norm(facing, axis=1, keepdims=True), 1e-12)
    to_viewer = -centres / np.linalg.norm(centres, axis=1, keepdims=True) if perspective else np.array([[0.0, 0.0, 1.0]])
    pixel = (-centres[:, 2] if perspective else np.ones(len(kept))) / float(np.mean(projection.scale))
    areas = count[kept] * pixel**2 / np.maximum((facing * to_viewer).sum(axis=1), LEAST_FACING)
    on_device = wp.array(solved.astype(np.uint8), dtype=wp.uint8, device=given.device)
    radiance = patch_radiance(given.stack, lights, pixels, patch, len(kept))
    cells = np.stack(np.divmod(kept, shape[1]), axis=1)
    return Patches(centres, facing, areas, cells, radiance, number.reshape(shape), side, on_device)


def patch_radiance(stack: Stack, lights: Lights, pixels: np.ndarray, patch: np.ndarray, patches: int) -> np.ndarray:
    """Return [patches, 3, lights] float32: mean radiance / irradiance of some pixels of each patch, evenly chosen.
    `pixels`, `patch`: [n] and the number of the patch of each."""
    order = np.argsort(patch, kind="stable")
    sizes = np.bincount(patch, minlength=patches)
    each = min(PIXELS_PER_PATCH, int(sizes.max()))
    first = np.cumsum(sizes) - sizes
    steps = (np.arange(each)[None] + 0.5) / each * sizes[:, None]
    chosen = pixels[order[first[:, None] + steps.astype(int)]]
    values, _ = stack.pick(chosen.reshape(-1))
    lit = stack.light_count
    stored = values[:, :lit].astype(np.float32).reshape(3, lit, patches, each).mean(axis=3)
    factor = np.divide(lights.scale[:lit, None], lights.irradiance[:lit], out=np.zeros_like(lights.irradiance[:lit]),
                       where=lights.irradiance[:lit] > 0)
    return np.maximum(np.moveaxis(stored * factor.T[:, :, None], 2, 0), 0)
