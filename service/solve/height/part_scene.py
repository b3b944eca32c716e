"""A surface whose parts move along the line of sight, with the readings that are compared with its shadows, on a thinned picture."""

import math
from typing import NamedTuple

import numpy as np
import warp as wp

from kernels.device import to_numpy
from kernels.photometric.lambertian.readings import Lights
from kernels.photometric.model.samples import evenly, readings_of
from kernels.photometric.shadows.shadow_evidence import shadow_odds
from kernels.surface.offsets import GROUPS, Offset, choose_offset, march_part, weigh_offsets
from kernels.surface.shadows import Projection, extent_of
from service.solve.base.batches import pick_pixels, view_directions
from service.solve.base.solution import SolveInput
from service.solve.height.height import mean_height, projection_of
from service.solve.height.thickness import guess_thickness
from stage.colour.colour import GREY_WEIGHTS

LEAST_SHARE = 0.003
"""Least part of the surface that is moved: a smaller one throws shadows of few readings."""
MOST_PARTS = 12
"""Most parts that are moved, the largest first."""
GRID_SIDE = 256
"""Longest side, in pixels, of the picture on which shadows are marched; larger ones are thinned."""
READINGS = 300_000
"""Most readings that are compared with shadows."""
MOST_LIGHTS = 128
"""Most lights whose shadows are compared."""
OPEN = 0.2
"""Half of the range of offsets, in parts of the object's size, that may stay open where a step counts as known."""
BLUR_PIXELS = 0.7
"""Standard deviation, in pixels of the thinned picture, of the place of a shadow's edge."""
LEAST_SIGMA_PIXELS = 0.7
"""Least σ of an offset, in pixels of the thinned picture: rays are followed pixel by pixel, and shapes err along outlines, which all lights
see alike. Errors of path-traced balls and rings are up to 0.8 pixels."""

IN_SHADOW = 1.5
"""Log odds of shadow from which on a reading is in shadow without doubt."""
LEAST_DARK = 0.001
"""Least part of the compared readings that must be in shadow without doubt before the surface is held against them."""
BESIDE = ((0, 0), (0, 2), (0, -2), (2, 0), (-2, 0))
"""Rows and columns, in pixels of the thinned picture, to which a shadow that the surface throws may lie aside of the one in the images."""
NO_PART = -2
"""The number of no part: against it none moves."""


class Material(NamedTuple):
    """The material of all pixels; F0 and roughness are None where the method estimates no highlight."""

    albedo: np.ndarray  # [3, pixels]
    specular: np.ndarray | None = None  # [3, pixels]
    roughness: np.ndarray | None = None  # [pixels]
    brushed: np.ndarray | None = None  # [n] positions of pixels with a streak for a highlight, beside which they are dark without a shadow

    def grey(self, pixels: np.ndarray) -> np.ndarray:
        """Return [n, 3] grey albedo, grey F0 and roughness of some pixels."""
        weights = np.asarray(GREY_WEIGHTS)
        f0 = np.zeros(len(pixels)) if self.specular is None else weights @ self.specular[:, pixels].astype(np.float64)
        rough = np.ones(len(pixels)) if self.roughness is None else self.roughness[pixels].astype(np.float64)
        return np.stack([weights @ self.albedo[:, pixels].astype(np.float64), f0, rough], axis=1)


class PartScene:
    """A surface whose parts move, and the shadows that its readings show; `show` says which parts, and where they are."""

    def __init__(self, given: SolveInput, lights: Lights, normal: np.ndarray, material: Material, mask: np.ndarray):
        """Compare the readings of a surface with its shadows. `mask`: [rows, cols] bool, where there is surface."""
        self._device, self._cols = given.device, mask.shape[1]
        self._mean = mean_height(given.camera)
        self._perspective = given.camera.projection == "perspective"
        whole = projection_of(given.camera)
        step = math.ceil(max(mask.shape) / GRID_SIDE)
        self._step, self._thin = step, (slice(step // 2, None, step),) * 2
        centre = wp.vec2(*((float(whole.centre[i]) - 0.5 - step // 2) / step + 0.5 for i in (0, 1)))
        self._projection = Projection(self._perspective, whole.scale / float(step), centre)
        pixel = 1.0 / (0.5 * (self._projection.scale[0] + self._projection.scale[1]))  # in log depth, or in the unit of height
        self._blur, self._pixel = BLUR_PIXELS * pixel, pixel
        self.size = float(max(np.ptp(axis) + 1 for axis in np.nonzero(mask))) * pixel / step
        """Longer side of the object, in the unit of offsets."""

        inside: np.ndarray = np.argwhere(mask[self._thin])
        lit = evenly(given.stack.light_count, MOST_LIGHTS)
        inside = inside[evenly(len(inside), READINGS // len(lit))]
        self._read, self._normal, self._view = inside, normal, view_directions(given.camera)
        pixels, view = self._positions(inside), self._view
        readings = readings_of(pick_pixels(given, lights, view, pixels))[:, lit]
        toward = lights.direction[: given.stack.light_count][lit].astype(np.float64)
        self._odds = shadow_odds(readings, toward, normal[:, pixels].T, view(pixels), material.grey(pixels), device=given.device)
        if material.brushed is not None:
            self._odds[np.isin(pixels, material.brushed)] = 0
        around = np.argsort(np.arctan2(toward[:, 1], toward[:, 0]))
        self._group = np.empty(len(lit), dtype=int)
        self._group[around] = np.arange(len(lit)) * GROUPS // len(lit)
        self._pixels = wp.array(inside.astype(np.int32), dtype=wp.vec2i, device=given.device)
        self._toward = wp.array(toward.astype(np.float32), dtype=wp.vec3, device=given.device)

    def show(self, height: np.ndarray, part: np.ndarray) -> None:
        """Let parts [rows, cols] int, -1 outside of the mask, move from where a height [rows, cols] has them."""
        self._height, self._part = height.astype(np.float64), part
        self._thin_part = np.ascontiguousarray(part[self._thin]).astype(np.int32)
        self._on = self._thin_part[tuple(self._read.T)]
        thinned = self._height[self._thin]
        surface = -np.log(np.maximum(-thinned, 1e-12)) if self._perspective else thinned
        pixels = self._positions(np.argwhere(self._thin_part >= 0))
        facing = np.zeros(thinned.shape)
        facing[self._thin_part >= 0] = (self._normal[:, pixels].T * self._view(pixels)).sum(axis=1)
        self._thickness = guess_thickness(surface, self._thin_part, facing, self._pixel)

    def _positions(self, inside: np.ndarray) -> np.ndarray:
        """Return the positions in the image of [n, 2] rows and columns of the thinned picture."""
        return (inside * self._step + self._step // 2) @ np.array([self._cols, 1])

    def step_of(self, number: int, *, against: list[int]) -> Offset:
        """Return how far a part should move against some others; the rest is not there."""
        there = [number, *against]
        parts = wp.array(np.where(np.isin(self._thin_part, there), self._thin_part, -1), dtype=wp.int32, device=self._device)
        odds = np.where(np.isin(self._on, there)[:, None], self._odds, 0)
        thinned = np.ascontiguousarray(self._height[self._thin], dtype=np.float32)
        height = wp.array(thinned, dtype=float, device=self._device)
        thickness = wp.array(self._thickness.astype(np.float32), dtype=float, device=self._device)
        box = extent_of(thinned, self._thin_part == number).box
        shadows = march_part(self._pixels, self._toward, height, parts, thickness, number, box, self._projection)
        evidence = weigh_offsets(shadows, odds, self._on == number, self._group, reach=self.size, blur=self._blur)
        return choose_offset(evidence, least_sigma=LEAST_SIGMA_PIXELS * self._blur / BLUR_PIXELS)

    def unexplained(self, height: np.ndarray, part: np.ndarray, sure: np.ndarray) -> float:
        """Return the share of the readings in shadow that a surface throws no shadow on, its parts as walls; 0 where hardly any reading
        is in shadow.

        Args:
            height: [rows, cols].
            part: [rows, cols] int, -1 outside of the mask.
            sure: [rows, cols] bool, where a normal is known well enough to tell shadow.
        """
        thinned, thin_part = (np.ascontiguousarray(values[self._thin]) for values in (height.astype(np.float32), part.astype(np.int32)))
        dark = (self._odds > IN_SHADOW) & sure[self._thin][tuple(self._read.T)][:, None]
        if dark.mean() < LEAST_DARK:
            return 0.0
        count = dark.sum()
        device = self._device
        surface, parts = wp.array(thinned, dtype=float, device=device), wp.array(thin_part, dtype=wp.int32, device=device)
        backs = wp.zeros(thinned.shape, dtype=float, device=device)  # of walls nothing passes behind
        box = extent_of(thinned, thin_part >= 0).box
        for aside in BESIDE:
            if not len(rows := np.flatnonzero(dark.any(axis=1))):  # those without a shadow on them so far
                break
            pixels = np.clip(self._read[rows] + aside, 0, np.array(thinned.shape) - 1).astype(np.int32)
            shadows = march_part(wp.array(pixels, dtype=wp.vec2i, device=device), self._toward, surface, parts, backs, NO_PART, box,
                                 self._projection)
            dark[rows] &= to_numpy(shadows.hidden) == 0
        return float(dark.sum() / count)

    def is_known(self, low: float, high: float) -> bool:
        """Return whether offsets between these bounds place a part."""
        return -self.size < low and high < self.size and high - low < 2 * OPEN * self.size

    def move(self, number: int, offset: float) -> None:
        """Move a part towards the viewer."""
        self.shift(self._height, self._part == number, offset)

    def shift(self, height: np.ndarray, mine: np.ndarray, offset: float) -> None:
        """Move some pixels [rows, cols] bool of a height towards the viewer, in place."""
        height[mine] = height[mine] * math.exp(-offset) if self._perspective else height[mine] + offset

    def level(self, height: np.ndarray, mine: np.ndarray) -> float:
        """Return the mean of some pixels [rows, cols] bool of a height, in the unit of offsets."""
        there = height[mine].astype(np.float64)
        return float((-np.log(-there) if self._perspective else there).mean())

    def in_heights(self, number: int, offset: Offset) -> Offset:
        """Return an offset in the unit of height."""
        if not self._perspective:
            return offset
        distance = -float(self._height[self._part == number].mean())
        return offset._replace(offset=distance * math.expm1(offset.offset), sigma=distance * offset.sigma)

    def whole_height(self) -> np.ndarray:
        """Return the height of the surface, its mean that of the camera."""
        inside = self._part >= 0
        mean = self._height[inside].mean()
        moved = self._height * (self._mean / mean) if self._perspective else self._height + (self._mean - mean)
        return np.where(inside, moved, 0).astype(np.float32)
