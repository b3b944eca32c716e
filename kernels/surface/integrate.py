"""Normals to height: least squares over all pairs of neighbours, breaking at discontinuities where asked."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from kernels.device import to_numpy
from kernels.errors import ArrayError
from kernels.surface.components import label_runs, place
from kernels.surface.conjugate import Convergence, Solver
from kernels.surface.discontinuities import find_breaks, integrate_broken
from kernels.surface.grid import EdgeWeights, Grid, make_grid
from kernels.surface.normal_map import NormalMap
from kernels.surface.slopes import Slopes, pair_slopes


@dataclass(frozen=True, kw_only=True)
class IntegrationOptions:
    """Options of the integration."""

    tolerance: float = 1.0e-6
    """The residual over its first value at which conjugate gradients stop; close to the relative error of the slopes."""
    max_iterations: int = 200
    """Seven to fifteen are usual, mazes and scattered holes take more."""
    discontinuities: bool = False
    """True if the surface may break where its normals contradict themselves: right for objects with parts in front of one another. On a
    smooth surface it changes nothing but the share of noise (6 % more error at most in our trials)."""


class Integration(NamedTuple):
    """Height of a surface."""

    height: wp.array  # [rows, cols] float32, camera-frame z, 0 outside
    components: int  # connected parts, each with a constant of its own
    iterations: int  # of conjugate gradients
    residual: float  # relative
    converged: bool
    fragment: np.ndarray | None = None
    """[rows, cols] int: pixels of one number are connected across no abrupt turn of the normals, -1 outside. None: breaks were not looked
    for."""
    part_of: np.ndarray | None = None
    """[fragments] int, the part of each fragment: fragments of one part meet along their outlines."""

    @property
    def part(self) -> np.ndarray | None:
        """[rows, cols] int: pixels of one number are connected across no break, -1 outside. None: breaks were not looked for."""
        return None if self.fragment is None or self.part_of is None else np.append(self.part_of, np.int32(-1))[self.fragment]


def integrate_normals(
    normal: np.ndarray | wp.array,  # [3, rows, cols] float32, camera frame
    mask: np.ndarray | wp.array,  # [rows, cols] bool or uint8
    x: np.ndarray | wp.array,  # [rows, cols] float32 or float64, right
    y: np.ndarray | wp.array,  # [rows, cols] float32 or float64, up
    *,
    perspective: bool,
    mean_z: float,
    sigma: np.ndarray | wp.array | None = None,  # [rows, cols] float16 or float32, degrees
    cuts: tuple[np.ndarray, np.ndarray] | None = None,  # [rows, cols] bool each
    kind: np.ndarray | None = None,  # [rows, cols] int
    options: IntegrationOptions | None = None,
    device: str,
    progress: Callable[[float], None] | None = None,
) -> Integration:
    """Integrate a normal map to a height map by weighted least squares.

    Normals do not tell the distance between parts of the mask that do not touch, so the mean of each part is mean_z.
    Raises ArrayError if shapes do not fit, the mask is empty, or mean_z cannot be.

    Args:
        normal: unit normals, n_z > 0 towards an orthographic viewer. A pixel whose normal is not finite, or shorter
            than a half, counts as outside the mask.
        mask: where there is surface; any shape, with holes, in any number of parts.
        x, y: plane coordinates of the pixels: metres (or any unit of length) for an orthographic camera, the slope of the
            ray, x of (x, y, −1), for a perspective one. Lens distortion is in these numbers.
        mean_z: mean camera-frame z of the surface; negative for a perspective camera.
        sigma: standard errors of the normals; None: all are sure.
        cuts: edges between a pixel and its right neighbour, and between it and the one below, that the surface breaks along; what
            they cut off is a part.
        kind: the kind of material of each pixel; where breaks are looked for, a surface may break between two kinds however its normals
            turn. None: all are of one.
        progress: told the fraction done, 0…1.

    Convention:
        Waits for the device: the mask of usable pixels and one number per mask run are read back, and the residual
        every few iterations. The inputs are read on the host, a band of rows at a time; arrays on a device are read back, and x and y
        may be views of one row and one column. Needs nine float32 per pixel beyond the inputs, and twelve where the surface breaks, of
        which one is on the host; a GPU holds the inputs too until breaks are found.
    """
    options = options or IntegrationOptions()
    _check(normal, mask, x, y, sigma, perspective=perspective, mean_z=mean_z)
    normal, mask, x, y = (_on_host(a) for a in (normal, mask, x, y))
    whole, box = mask.shape, _box(mask)
    x, y = x[box], y[box]
    rows, cols = x.shape
    grid = make_grid(rows, cols, device)
    spacing = _spacing(x, y)
    surface = NormalMap(normal[:, *box], mask[box], x, y, None if sigma is None else _on_host(sigma)[box], perspective=perspective,
                        device=device)
    slopes, usable = pair_slopes(surface, grid=grid, spacing=spacing)
    if cuts is not None:
        cut_edges(slopes.weights, tuple(cut[box] for cut in cuts), grid=grid)
    runs = label_runs(usable)
    del usable

    def improve(slopes: Slopes, h: wp.array, *, last: bool) -> Convergence:
        solver = Solver(grid, slopes, max_iterations=options.max_iterations, overwrite=last)
        return solver.solve(h, tolerance=options.tolerance, progress=progress)

    if options.discontinuities:
        breaks = find_breaks(slopes, surface, None if kind is None else kind[box], grid=grid, spacing=spacing)
        del slopes, surface, x, y  # the solver needs the memory
        h, fragment, part_of, done = integrate_broken(breaks, grid=grid, solve=improve)
        fragment = grid.pixels(fragment)
        del breaks
    else:
        h, fragment, part_of = grid.zeros(), None, None
        done = improve(slopes, h, last=True)
    height = place(h, runs, grid=grid, perspective=perspective, spacing=spacing, mean_z=mean_z)
    if (rows, cols) != whole:
        inside, height = height, wp.zeros(whole, dtype=wp.float32, device=device)
        wp.copy(height[box], inside)
        inner, fragment = fragment, None if fragment is None else np.full(whole, -1, dtype=fragment.dtype)
        if fragment is not None:
            fragment[box] = inner
    if progress is not None:
        progress(1.0)
    return Integration(height, runs.count, done.iterations, done.residual, done.converged, fragment, part_of)


def cut_edges(weights: EdgeWeights, cuts: Iterable[np.ndarray], *, grid: Grid) -> None:
    """Take edges away, in place; `cuts`: [rows, cols] bool, edges to the right and edges down."""
    for plane, cut in zip((weights.right, weights.down), cuts, strict=True):
        kept = to_numpy(plane)
        grid.pixels(kept)[cut] = 0
        plane.assign(kept)


def _on_host(a: np.ndarray | wp.array) -> np.ndarray:
    return a if isinstance(a, np.ndarray) else to_numpy(a)


def _box(mask: np.ndarray) -> tuple[slice, slice]:
    """Return the rows and columns between the first and the last pixel of a mask."""
    rows, cols = (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0))
    return slice(int(rows[0]), int(rows[-1]) + 1), slice(int(cols[0]), int(cols[-1]) + 1)


def _check(normal: Any, mask: Any, x: Any, y: Any, sigma: Any, *, perspective: bool, mean_z: float) -> None:
    if len(mask.shape) != 2:
        raise ArrayError(f"mask has shape {tuple(mask.shape)}: give [rows, cols]")
    if tuple(normal.shape) != (3, *mask.shape):
        raise ArrayError(f"normal has shape {tuple(normal.shape)}, mask {tuple(mask.shape)}: give [3, rows, cols]")
    for name, a in (("x", x), ("y", y), ("sigma", x if sigma is None else sigma)):
        if tuple(a.shape) != tuple(mask.shape):
            raise ArrayError(f"{name} has shape {tuple(a.shape)}, mask {tuple(mask.shape)}: give one value per pixel")
    for name, a in (("normal", normal), ("x", x), ("y", y), ("sigma", sigma)):
        if isinstance(a, wp.array) and a.dtype is not wp.float32:
            raise ArrayError(f"{name} holds {a.dtype.__name__}: give float32")
    if not np.isfinite(mean_z):
        raise ArrayError(f"mean_z is {mean_z}: give a finite height")
    if perspective and mean_z >= 0.0:
        raise ArrayError(f"mean_z is {mean_z}, and a perspective camera looks along −z: give a negative one")
    if 0 in mask.shape or not (mask if isinstance(mask, np.ndarray) else to_numpy(mask)).any():
        raise ArrayError("mask is empty: mark the pixels that show the surface")


def _spacing(x: np.ndarray, y: np.ndarray) -> float:
    """Return the mean distance between neighbours along the middle row (or column, where the picture is one pixel wide)."""
    rows, cols = x.shape
    line = [(a[rows // 2] if cols > 1 else a[:, 0]).astype(np.float32).astype(np.float64) for a in (x, y)]
    step = np.hypot(*(np.diff(values) for values in line))
    step = step[np.isfinite(step)]
    mean = float(step.mean()) if step.size else 0.0
    return mean if mean > 0.0 else 1.0
