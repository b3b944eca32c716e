"""Test whether the axes of the lights are those of the camera, from the surface that was solved with them.

Mirrored or turned lights explain the images as well as the right ones. What tells them apart: a visible surface faces the camera, its
slopes are those of one height (service.light_estimation.axes), and the outline and the cast shadows of what is not hollow
(service.light_estimation.object_outline).
"""

from collections.abc import Callable

import numpy as np

from kernels.device import to_numpy
from kernels.photometric.model.samples import evenly, some_of
from kernels.status import ESTIMATED
from kernels.surface.integrate import IntegrationOptions, integrate_normals
from service.light_estimation.axes import Axes, sites, wrong_axes
from service.light_estimation.explanations import grey_readings
from service.light_estimation.lambertian import FACING, Fit, degrees_between, median_of
from service.light_estimation.light_axes import (
    CLEAR,
    INVERSE,
    INWARD,
    Grid,
    LightAxes,
    SmallMap,
    describe,
    is_clear,
    light_axes,
    toward_viewer,
)
from service.light_estimation.object_outline import Outline, cast_shadows
from service.solve.base.solution import Solution, SolveInput
from stage.capture.point_lights import DistantLights

MAP_SIZE = 120
"""Pixels across the small map on which the outline and shadows are compared."""
LEAST_LIGHTS = 4
"""Fewer lights may lie almost in a plane, and then most normals of noise face away."""
SHADOW_PIXELS, SHADOW_LIGHTS = 2000, 64
"""Pixels and lights of which cast shadows are compared."""
LEAST_COSINE, LEVEL_COSINE = 0.1, 0.25
"""Least n·l of a reading that is compared, and of those whose median gives the level of the pixel."""
LIT = 0.7
"""A reading above this part of level · n·l is lit: light from other surfaces in a cast shadow of a white bowl mostly stays below it."""
MANY_LIGHTS = 6
"""Fewer lights seldom contradict a height: their normals leave no misfit, and shadows turn them."""
LEAST_SHADOWS, LEAST_SHADOWS_A_LIGHT, LEAST_SHADOWS_ALONE = 30, 4, 400
"""Least count of readings that the height puts in shadow, and of those under one light, for them to speak against an outline, and alone:
an inverted object has 5 and more under a light, a white bowl whose walls look flat 3."""
LIT_INVERTED, LIT_WRONG, MORE_LIT = 0.85, 0.6, 0.05
"""An inverted surface is lit in all the shadows that it should cast (0.89 to 1), but where the right one casts some: then from the second
part on, and by the third part more than where the inverse casts its own (0.05 to 0.7 on objects of several parts, whose heights have false
steps; right ones as much less). Where an outline speaks for it, and the inverse casts many shadows, which that of a hollow does not, any
more is enough. In right hollows at most 0.77 is lit, in white ones under three to five lights 0.84, and their inverses cast no shadow, or
one that is lit more."""
LEAST_SHADOWS_RIGHT, LEAST_SHADOWS_HOLLOW = 20, 8
"""Least count of readings that the inverse puts in shadow, and of those in shadow that show a hollow if less than LIT_WRONG is lit."""


def find_axes(given: SolveInput, solution: Solution, lights: DistantLights | None, fit: Fit | None) -> LightAxes | None:
    """Return which axes of the lights are exchanged, mirrored or turned, or None.
    `lights`: the distant lights; None: other lights, whose readings are not fitted again. `fit`: the fit of some pixels under these
    lights, or None."""
    if lights is not None and fit is not None and len(lights.direction) >= LEAST_LIGHTS and fit.facing < FACING:
        return _exchanged(given, lights, fit)
    estimated = np.isin(solution.status, ESTIMATED).reshape(given.mask.shape)
    positions = sites(estimated)
    flat = solution.normal[:, positions.reshape(-1)]
    normals = np.moveaxis(toward_viewer(given.camera, flat, positions.reshape(-1)).reshape(3, *positions.shape), 1, 0)
    found = wrong_axes(normals, strict=given.stack.light_count < MANY_LIGHTS)
    if found is None:
        return None
    return light_axes(_map_of(given, solution.normal, estimated).corrections(found, np.eye(3)), found)


def find_inversion(given: SolveInput, solution: Solution, lights: DistantLights | None) -> LightAxes | None:
    """Say whether the surface is inverted, as by lights that are turned by 180 degrees about the view axis; shadows are compared under
    distant lights alone."""
    estimated = np.isin(solution.status, ESTIMATED).reshape(given.mask.shape)
    if not estimated.any():
        return None
    small = _map_of(given, solution.normal, estimated)
    edge = small.edge
    if edge.outward >= CLEAR:
        return None
    inward, decided = is_clear(edge), None
    if lights is not None:
        decided = _is_inverted(_Shadows(given, solution.normal, small, lights), edge, len(lights.direction))
    if decided:
        return LightAxes("the surface looks inverted: with x and y negated (turned by 180° about the view axis) it casts the shadows that "
                         "the images show; check the axes (x right, y up, z towards the camera)", (INVERSE,))
    if decided is not None or not inward:
        return None
    return LightAxes(INWARD)


def is_upright(given: SolveInput, lights: DistantLights, normals: Callable[[np.ndarray], np.ndarray]) -> bool | None:
    """Return whether the images have the cast shadows of a surface, or those of its inverse; None where they do not tell.
    `normals`: returns the normals [3, n] of pixels [n], seen by an orthographic camera."""
    grid = Grid.of(given.mask, MAP_SIZE)
    normal = np.zeros((3, given.mask.size), np.float32)
    found = normals(grid.chosen)
    told = np.isfinite(found).all(axis=0)
    grid.inside[grid.inside] = told
    normal[:, grid.chosen] = found[:, told]
    small = SmallMap(np.where(grid.inside, normal[:, grid.pixels.reshape(-1)].reshape(3, *grid.pixels.shape), 0), grid)
    if not told.any():
        return None
    shadows = _Shadows(given, normal, small, lights)
    (count, lit), (count_inverse, lit_inverse) = shadows.of_surface(), shadows.of_inverse()
    if min(count, count_inverse) < LEAST_SHADOWS_ALONE or min(lit, lit_inverse) >= LIT_WRONG or abs(lit - lit_inverse) < MORE_LIT:
        return None
    return lit < lit_inverse


def _is_inverted(shadows: "_Shadows", edge: Outline, lights: int) -> bool | None:
    """Return whether cast shadows say that a surface is inverted; None where they do not decide.

    Many `lights` can contradict the surface by its own shadows; they do it alone where no outline speaks for the inversion.
    """
    alone, many = not is_clear(edge), lights >= MANY_LIGHTS
    count, lit = shadows.of_surface()
    if count < (LEAST_SHADOWS_ALONE if alone else max(LEAST_SHADOWS, LEAST_SHADOWS_A_LIGHT * min(lights, SHADOW_LIGHTS))):
        return False if count >= LEAST_SHADOWS_HOLLOW and lit < LIT_WRONG else None
    count_inverse, lit_inverse = shadows.of_inverse()
    ahead = MORE_LIT if alone or count_inverse < LEAST_SHADOWS_ALONE else 0.0
    explained = count_inverse >= LEAST_SHADOWS_RIGHT and lit_inverse <= lit - ahead
    if alone:
        return many and explained and lit >= LIT_WRONG and edge.outward <= 0
    if ahead == 0 and not explained and lit >= max(LIT_WRONG, lit_inverse - MORE_LIT):
        return None
    if many or explained:
        return lit >= (LIT_WRONG if explained else LIT_INVERTED)
    return False if lit < LIT_INVERTED else None


def _exchanged(given: SolveInput, lights: DistantLights, fit: Fit) -> LightAxes | None:
    """Return the signed axis that is the view axis, when most normals face away, and what then is wrong in the image plane."""
    if fit.towards_camera is None:
        return None
    axis, sign, share = fit.towards_camera
    exchange = np.eye(3)
    exchange[[2, axis]] = exchange[[axis, 2]]
    exchange[2] *= sign
    grid = Grid.of(given.mask)
    radiance, usable = given.stack.pick_radiance(grid.chosen)
    small = SmallMap.fitted(given.camera, grid, grey_readings(radiance, lights.irradiance), usable, lights.direction, exchange)
    found = small.wrong_axes() or Axes(np.eye(2), 1 - fit.facing, 1 - share)
    matrices = small.corrections(found, exchange)
    if len(matrices) > 1:  # nothing decides: the smaller change is the likelier mistake
        matrices = (max(matrices, key=lambda matrix: float(np.trace(matrix))),)
    behind = (f"all {len(lights.direction)} lights are behind the object (z ≤ 0), and yet light what the camera sees"
              if (lights.direction[:, 2] <= 0).all() else f"{100 * (1 - fit.facing):.0f} % of the normals face away from the camera")
    turned = degrees_between(matrices[0] @ fit.normal, fit.normal)
    return LightAxes(f"{behind}: with {describe(matrices[0])}, {100 * share:.0f} % face it; check the axes (x right, y up, z towards the "
                     "camera)", matrices, float(np.median(turned)))


class _Shadows:
    """The cast shadows of a surface and of its inverse, compared with readings."""

    def __init__(self, given: SolveInput, normal: np.ndarray, small: SmallMap, lights: DistantLights) -> None:
        """Integrate a small map, and read some of its pixels under some of the lights.
        `normal`: [3, pixels of the image], known at those of the small map."""
        mask = small.grid.inside
        rows, cols = mask.shape
        across = (np.broadcast_to(np.arange(cols), (rows, cols)), np.broadcast_to(-np.arange(rows)[:, None], (rows, cols)))
        self._height = to_numpy(integrate_normals(
            small.normal, mask, *(plane.astype(np.float32) for plane in across), perspective=False, mean_z=0.0,
            options=IntegrationOptions(discontinuities=True), device=given.device).height)
        self._mask, self._chosen = mask, some_of(mask, SHADOW_PIXELS)
        some = evenly(len(lights.direction), SHADOW_LIGHTS)
        pixels = small.grid.pixels.reshape(-1)[self._chosen]
        radiance, usable = given.stack.pick_radiance(pixels)
        readings = grey_readings(radiance[some], lights.irradiance[some])
        self._direction = lights.direction[some]
        cosine = self._direction @ normal[:, pixels]
        level = median_of(readings / np.maximum(cosine, LEVEL_COSINE), (cosine > LEVEL_COSINE) & usable[some])
        self._compared = (cosine > LEAST_COSINE) & usable[some] & (level > 0)
        self._lit = readings > LIT * level * cosine

    def of_surface(self) -> tuple[int, float]:
        """Return how many readings the surface puts in cast shadow, and which part of them is lit."""
        return self._part_lit(self._height, self._direction)

    def of_inverse(self) -> tuple[int, float]:
        """Return the same of the inverse."""
        return self._part_lit(-self._height, self._direction @ INVERSE)

    def _part_lit(self, height: np.ndarray, direction: np.ndarray) -> tuple[int, float]:
        shadow = cast_shadows(height, self._mask, self._chosen, direction) & self._compared
        return int(shadow.sum()), float(self._lit[shadow].mean()) if shadow.any() else 0.0


def _map_of(given: SolveInput, normal: np.ndarray, mask: np.ndarray) -> SmallMap:
    grid = Grid.of(mask, MAP_SIZE)
    return SmallMap.of(given.camera, grid, normal[:, grid.chosen])
