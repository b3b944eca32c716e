"""The light that an object gets from the ground that it lies on.

A table, a cloth or a sheet of paper below an object sends on the light of the lamps, and what it sends is in the images: outside the mask.
The ground is taken as a plane below the object, which faces as its own readings say. A half of an object's depth is out of sight below its
outline; an even ground sends as much to a surface whatever its distance, so that this matters little. The images do not say whether the
ground goes on beyond them, nor whether what they show there is a ground at all: readings of the object do.
"""

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import warp as wp
from scipy.ndimage import maximum_filter

from kernels.photometric.lambertian.readings import Lights
from service.light_estimation.lambertian import fit_lambertian
from service.solve.base.solution import SolveInput
from service.solve.height.height import projection_of
from service.solve.height.interreflection import LEAST_COVER, Patches, patch_radiance

REACHES = (1, 3, 27)
"""Images, side by side, over which the ground may reach: no farther than is seen, as a table does, or as a floor. Beyond the image it is
as bright as the median of what is seen: where shadows end is not known."""
LIKELY = np.array([0.1, 0.2, 0.4, 0.3])
"""Likelihood of each way before the readings are asked: what is around the object lights it not, or reaches so far."""
BLOCKS = 32
"""Blocks of the ground along the longer side of the image: what stands on it hides parts of it, and throws shadows there."""
FINE = 8
"""Most pixels along a side of a block that are looked at."""
MARGIN = 0.01
"""Part of the longer side of the image, around the mask, in which a pixel may show the object."""
BELOW = 0.5
"""Depth of an object below its outline, over its depth above that."""
LOWEST_PERCENTILE = 1.0
"""Percentile of the heights of an object that stands for the least."""
LEAST_RADIANCE = 0.01
"""Radiance of the ground over that of the object, both in the mean, below which it is dark: a vertical wall gets half as much of it."""
LEAST_COSINE = 0.2
"""Cosine between the ground and the line of sight below which a block of it has no certain place."""


class Ground(NamedTuple):
    """What the images show of the ground."""

    given: SolveInput
    seen: np.ndarray  # [blocks, 3, lights] radiance over irradiance
    shown: np.ndarray  # [rows, cols] bool, by blocks: where they are
    side: int
    """Pixels along a side of a block."""
    facing: np.ndarray  # [3] unit normal

    @classmethod
    def of(cls, given: SolveInput, lights: Lights, patches: Patches) -> "Ground | None":
        """Return the ground below an object, or None where the images show none, or a dark one."""
        rows, cols = given.mask.shape
        side = math.ceil(max(rows, cols) / BLOCKS)
        shape = (-(-rows // side), -(-cols // side))
        step = math.ceil(side / FINE)
        grown = maximum_filter(given.mask, 2 * math.ceil(MARGIN * max(rows, cols)) + 1)
        row, col = (axis.ravel() for axis in np.mgrid[step // 2:rows:step, step // 2:cols:step])
        block = row // side * shape[1] + col // side
        free = ~grown[row, col]
        looked, found = (np.bincount(block[some], minlength=shape[0] * shape[1]) for some in (slice(None), free))
        shown = (found > LEAST_COVER * looked).reshape(shape)
        if not shown.any():
            return None
        number = np.where(shown, np.cumsum(shown).reshape(shape) - 1, -1)
        inside = free & shown.flat[block]
        seen = patch_radiance(given.stack, lights, (row * cols + col)[inside], number.flat[block[inside]], int(shown.sum()))
        if seen.mean() <= LEAST_RADIANCE * patches.radiance.mean():
            return None
        return cls(given, seen, shown, side, _facing(seen, lights))

    def light_on(self, patches: Patches, height: wp.array) -> np.ndarray:
        """Return the light that it throws on each patch of the object, [ways, patches, 3, lights] as of `ArrivingLight`: none, and that by
        each of REACHES. `height`: [rows, cols] float32 on the device."""
        usual = np.median(self.seen, axis=0)
        light = np.zeros((len(LIKELY), *patches.radiance.shape), np.float32)
        for reach, blocks in _rings(self.shown, self.side):
            ground, placed = _plane(self.given, patches, self.facing, blocks)
            if len(placed):
                radiance = self.seen[placed] if reach == 1 else np.repeat(usual[None], len(placed), axis=0)
                sent = ground._replace(radiance=radiance).light_on(patches, height, projection_of(self.given.camera))
                light[1 + np.flatnonzero(np.array(REACHES) >= reach)] += sent
        return light


class _Blocks(NamedTuple):
    """Square blocks of a plane as the camera sees it."""

    cells: np.ndarray  # [blocks, 2] int, row and column of each
    middle: np.ndarray  # [blocks, 2] row and column in the image, pixels from its corner
    side: int
    """Pixels along a side."""


def _rings(shown: np.ndarray, side: int) -> Iterator[tuple[int, _Blocks]]:
    """Yield the images, side by side, over which the ground reaches with each ring of blocks, and the ring: that of the image itself, where
    it is `shown` [rows, cols] by blocks of `side` pixels, and three around it, each thrice as wide as the one before."""
    shape = np.array(shown.shape)
    cells = np.argwhere(shown)
    yield 1, _Blocks(cells, (cells + 0.5) * side, side)
    cells = np.argwhere(np.pad(np.zeros_like(shown), [(part, part) for part in shape], constant_values=True))
    reach = 3
    while reach <= REACHES[-1]:
        wide = side * reach // 3
        yield reach, _Blocks(cells, (cells + 0.5 - 1.5 * shape) * wide + shape / 2 * side, wide)
        reach *= 3


def _facing(seen: np.ndarray, lights: Lights) -> np.ndarray:
    """Return the unit normal of the ground, [3], by Lambert's law: the median of its blocks. `seen`: [blocks, 3, lights] radiance over
    irradiance."""
    readings = seen.mean(axis=1).T.astype(np.float64)
    fit = fit_lambertian(readings, readings > 0, lights.direction[:len(readings)].astype(np.float64))
    facing = np.median(fit.normal, axis=1)
    return facing / np.linalg.norm(facing)


def _plane(given: SolveInput, patches: Patches, facing: np.ndarray, blocks: _Blocks) -> tuple[Patches, np.ndarray]:
    """Return blocks of the ground, without their radiance, and the numbers of those that have a place. `facing`: [3] its unit normal."""
    camera, scale = given.camera.model_copy(update={"distortion": None}), float(np.mean(projection_of(given.camera).scale))
    hidden, low = patches.centres.copy(), np.percentile(patches.centres[:, 2], LOWEST_PERCENTILE)
    hidden[:, 2] = low - BELOW * (hidden[:, 2] - low)
    offset = min(np.percentile(each @ facing, LOWEST_PERCENTILE) for each in (patches.centres, hidden))
    x, y = camera.plane_at(*blocks.middle[:, ::-1].T)  # without distortion: its polynomial does not hold so far outside
    perspective = camera.projection == "perspective"
    start = np.zeros((len(x), 3)) if perspective else np.stack([x, y, np.zeros_like(x)], axis=1)
    sight = np.stack([x, y, np.full_like(x, -1.0)], axis=1) if perspective else np.tile([0.0, 0.0, -1.0], (len(x), 1))
    cosine = -sight @ facing / np.linalg.norm(sight, axis=1)
    away = (offset - start @ facing) / np.where(cosine >= LEAST_COSINE, sight @ facing, -1)
    placed = np.flatnonzero((cosine >= LEAST_COSINE) & ((away > 0) | (not perspective)))
    centres = (start + away[:, None] * sight)[placed]
    areas = (blocks.side / scale * (away[placed] if perspective else 1.0))**2 / -(sight @ facing)[placed]
    return patches._replace(centres=centres, facing=np.tile(facing, (len(placed), 1)), areas=areas,
                            cells=blocks.cells[placed]), placed
