"""Measure solder paste: the volume, height, area and offset of what lies on each pad, with σ, and the pads that paste connects.

The floor of a pad is the quadratic surface through what lies around it and near no pad, by Tukey's weights, so that a trace of copper does
not lift it.
All within half a pad's smaller side of it, and nearer to it than to any other, belongs to the pad. Its volume is the sum of the heights
over its opening, what is as high as a bridge, and the flanks around both, so that noise averages out and no threshold takes a part; area
and offset are those of the outline at a level. Copper under the mask that comes as near as a flank counts as paste.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.ndimage import distance_transform_edt, find_objects, label, median_filter, zoom
from scipy.special import ndtr

from service.boards.stitching.blending import TileErrors
from service.boards.stitching.grid import BoardGrid, HeightMap, robust_sigma
from stage.formats.gerber import Pad
from stage.spread import tukey_weights

REACH = 0.5
"""Distance up to which paste belongs to a pad, as a part of the pad's smaller side."""
LEAST_RING, GROWTHS = 60, 4
"""The fewest pixels around a pad that tell its floor, and how often the surroundings double to have them."""
BLOCK = 4
"""Blocks along the smaller side of a pad: the means of such blocks of the floor scatter by noise, and by relief that neighbours share."""
LEAST_BRIDGED = 0.02
"""The part of two openings that one piece of paste must cover to connect them."""
FLANK = 0.15
"""Width of the flanks, as a part of a pad's smaller side, that belong to its volume around its opening and what is higher than a bridge."""
FINE = 4
"""Parts of a pixel, along each side, between which heights are interpolated to find the outline of the paste."""
EDGE_PX = 0.1
"""Standard deviation of the place of each side of the outline, pixels, that interpolation leaves."""
ROUNDS = 6
EXTRAPOLATED = 1.5
"""How far from the middle of a pad its floor goes on, in longer sides of the pad; beyond, it is level."""


class Measured(NamedTuple):
    """A value and its standard deviation, in the unit of the value."""

    value: float
    sigma: float


class PadPaste(NamedTuple):
    """The paste of one pad."""

    seen: float
    """Part of its opening, or of all where paste belongs to it if that is less, that was measured."""
    volume_m3: float
    values: dict[str, Measured]
    """volume, height and area, in per cent of the nominal ones."""
    offset_m: np.ndarray  # [2] from the middle of the opening to that of the area, metres; NaN without an area
    offset_variance_m2: np.ndarray  # [2]


class Paste(NamedTuple):
    """The paste of all pads."""

    height: HeightMap
    """Heights above the floor of the nearest pad."""
    pads: list[PadPaste | None]
    """None: nothing of its surroundings was measured, or no floor."""
    bridges: list[tuple[int, ...]]
    """The pads that a piece of paste connects."""
    bridge_level_m: float


class _Floor(NamedTuple):
    """The floor of a pad: coefficients of 1, y, x, y², y·x and x², in rows and columns from the middle of its box, and σ in the middle."""

    coefficients: np.ndarray
    sigma: float


NOWHERE = _Floor(np.full(6, np.nan), np.nan)
"""Too little around the pad was measured."""


class _Cells(NamedTuple):
    openings: np.ndarray  # [rows, cols] the pad, from 1, whose opening holds a pixel; 0: none
    nearest: np.ndarray  # [rows, cols] the pad that is nearest
    own: np.ndarray  # [rows, cols] the pad to which paste at a pixel belongs; 0: none


def measure_paste(heights: HeightMap, pads: Sequence[Pad], errors: TileErrors | None = None, *, stencil_m: float, area_level: float,
                  bridge_level: float) -> Paste:
    """Measure the paste on all pads.
    `errors`: those of the tiles of the heights; None: there are no tiles, and shared errors are those of the heights.
    `area_level`, `bridge_level`: heights, as parts of the stencil's, above which pixels belong to the area, and above which paste connects
    pads."""
    cells = _cells(heights, pads)
    away = heights.measured & (cells.own == 0)
    boxes = find_objects(cells.own, max_label=len(pads))
    floors = [NOWHERE] * (len(pads) + 1)
    for number, box in enumerate(boxes, start=1):
        if box is not None:
            floors[number] = _floor(heights.height, away, box)
    level = heights._replace(height=heights.height - _floor_map(floors, boxes, cells.nearest, pads, heights.grid.pixel_m))
    levels = area_level * stencil_m, bridge_level * stencil_m
    found = [None if box is None or floors[number] is NOWHERE else
             _measure(level, box, cells.own[box] == number, pads[number - 1], errors, floors[number].sigma, stencil_m, levels)
             for number, box in enumerate(boxes, start=1)]
    return Paste(level, found, _bridges(level, cells.openings, levels[1]), levels[1])


def openings_of(grid: BoardGrid, pads: Sequence[Pad]) -> np.ndarray:
    """Return the pad, from 1, whose opening holds a pixel, [rows, cols]; 0 where none does."""
    out = np.zeros((grid.rows, grid.cols), dtype=np.int32)
    for number, pad in enumerate(pads, start=1):
        top, left = grid.place(pad.low_m[0], pad.low_m[1] + pad.size_m[1])
        bottom, right = grid.place(pad.low_m[0] + pad.size_m[0], pad.low_m[1])
        rows, cols = (slice(max(int(np.ceil(first)), 0), max(int(np.floor(last)) + 1, 0)) for first, last in ((top, bottom), (left, right)))
        part = out[rows, cols]
        x, y = grid.coordinates(*np.mgrid[rows.start : rows.start + part.shape[0], cols.start : cols.start + part.shape[1]])
        part[pad.holds(x, y)] = number
    return out


def _cells(heights: HeightMap, pads: Sequence[Pad]) -> _Cells:
    openings = openings_of(heights.grid, pads)
    distance, (row, col) = distance_transform_edt(openings == 0, return_indices=True)
    nearest = openings[row, col]
    reach = np.array([0.0, *(REACH * pad.size_m.min() / heights.grid.pixel_m for pad in pads)])
    return _Cells(openings, nearest, np.where(distance <= reach[nearest], nearest, 0))


def _floor(height: np.ndarray, away: np.ndarray, box: tuple[slice, ...]) -> _Floor:
    """Return the floor of a pad, whose box has these rows and columns, from the heights around it."""
    grow = max(side.stop - side.start for side in box) // 2
    for _ in range(GROWTHS):
        around = tuple(slice(max(side.start - grow, 0), side.stop + grow) for side in box)
        row, col = np.nonzero(away[around])
        if row.size >= LEAST_RING:
            break
        grow *= 2
    else:
        return NOWHERE
    values = height[around][row, col]
    down, right = (at + side.start - (inner.start + inner.stop - 1) / 2 for at, side, inner in zip((row, col), around, box, strict=True))
    basis = _terms(down, right)
    found, weight = np.zeros(basis.shape[1]), np.ones(row.size)
    found[0] = np.median(values)
    for _ in range(ROUNDS):
        left = values - basis @ found
        scale = max(robust_sigma(left), 1e-12)
        weight = tukey_weights(left, scale)
        found = np.linalg.lstsq(basis * np.sqrt(weight)[:, None], values * np.sqrt(weight), rcond=None)[0]
    side = max(round(min(edge.stop - edge.start for edge in box) / (1 + 2 * REACH) / BLOCK), 2)
    _, block = np.unique(row // side * (col.max() + 1) + col // side, return_inverse=True)
    count = np.bincount(block)
    means = (np.bincount(block, values - basis @ found) / count)[count >= side * side / 2]
    spread = np.linalg.pinv((basis * weight[:, None]).T @ basis)[0, 0]
    return _Floor(found, max(robust_sigma(means) * side, scale) * float(np.sqrt(spread)))


def _terms(down: np.ndarray, right: np.ndarray) -> np.ndarray:
    return np.stack([np.ones_like(down), down, right, down * down, down * right, right * right], axis=-1)


def _floor_map(floors: Sequence[_Floor], boxes: Sequence[tuple[slice, ...] | None], nearest: np.ndarray, pads: Sequence[Pad], pixel_m: float
               ) -> np.ndarray:
    """Return the floor of the nearest pad at every pixel, [rows, cols]."""
    out = np.full(nearest.shape, np.nan)
    order = np.argsort(nearest, axis=None)
    for number, pixels in zip(*_groups(nearest.ravel()[order], order), strict=True):
        box = boxes[number - 1]
        if box is not None:
            reach = EXTRAPOLATED * pads[number - 1].size_m.max() / pixel_m
            down, right = (np.clip(at - (side.start + side.stop - 1) / 2, -reach, reach)
                           for at, side in zip(np.unravel_index(pixels, nearest.shape), box, strict=True))
            out.ravel()[pixels] = _terms(down, right) @ floors[number].coefficients
    return out


def _groups(numbers: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, list[np.ndarray]]:
    """Return the numbers that occur in a sorted list, and the values of each."""
    unlike, first = np.unique(numbers, return_index=True)
    return unlike, np.split(values, first[1:])


def _measure(whole: HeightMap, box: tuple[slice, slice], own: np.ndarray, pad: Pad, errors: TileErrors | None, floor_sigma: float,
             stencil_m: float, levels_m: tuple[float, float]) -> PadPaste | None:
    """Measure the paste of a pad in its box; missing pixels are as high as the nearest measured one, to within the stencil.
    `levels_m`: those of the area and of bridges."""
    part, place = whole.cut(box), np.stack(whole.grid.coordinates(*np.mgrid[box]))
    known, square = part.measured & own, part.grid.pixel_m**2
    if not known.any():
        return None
    row, col = distance_transform_edt(~known, return_distances=False, return_indices=True)
    height = part.height[row, col]
    variance = np.where(known, part.variance, stencil_m**2 / 12)
    shared = np.hypot((part.systematic if errors is None else errors.steady[box])[row, col], floor_sigma)

    def by_shifts(values: np.ndarray, within: np.ndarray) -> float:
        return 0.0 if errors is None else errors.shift_sigma(box, (row, col), values, within)

    opening, smooth = pad.holds(*place), median_filter(height, 3)
    flank = FLANK * pad.size_m.min() / part.grid.pixel_m
    held = own & (distance_transform_edt(~(opening | (own & (smooth > levels_m[1])))) <= flank)
    volume, full = float(height[held].sum()) * square, pad.area_m2 * stencil_m
    volume_sigma = math.hypot(math.sqrt(variance[held].sum()), shared[held].sum(), by_shifts(height, held)) * square

    edge, size = levels_m[0], pad.area_m2 / square
    fine = zoom(np.where(own, smooth, 0.0), FINE, order=1, mode="nearest", grid_mode=True) > edge
    count = fine.sum() / FINE**2
    nominal = _outlined(part.grid, box, own, pad)
    doubt = np.where(own, ndtr((smooth - edge) / np.sqrt(variance)), 0)
    doubt = doubt * (1 - doubt)
    step = max(float(np.median(shared[own])), 0.02 * stencil_m)
    slope = abs(int((own & (smooth > edge - step)).sum()) - int((own & (smooth > edge + step)).sum())) / (2 * step)
    sides = EDGE_PX * pad.size_m / part.grid.pixel_m
    outline = math.sqrt(doubt.sum() + (slope * np.median(shared[own])) ** 2 + 2 * sides @ sides)
    area_sigma = math.hypot(outline, by_shifts((smooth > edge).astype(np.float64), own))
    top = own & (smooth > edge) if count else own & opening
    tall = max(int(top.sum()), 1)
    mean = float(zoom(height, FINE, order=1, mode="nearest", grid_mode=True)[fine].mean() if count else height[top].sum() / tall)
    height_sigma = math.hypot(math.sqrt(variance[top].sum()) / tall, shared[top].mean() if top.any() else stencil_m,
                              outline / tall * max(mean - edge, 0.0) if count else 0.0,
                              by_shifts(np.where(top, height - mean, 0), own) / tall)
    values = {"volume_percent": Measured(volume / full, volume_sigma / full),
              "area_percent": Measured(float(count / nominal), float(area_sigma / nominal)),
              "height_percent": Measured(mean / stencil_m, height_sigma / stencil_m)}
    offset, spread = np.full(2, np.nan), np.full(2, np.nan)
    if count:
        rows, cols = np.nonzero(fine)
        x, y = part.grid.coordinates((rows.mean() + 0.5) / FINE - 0.5, (cols.mean() + 0.5) / FINE - 0.5)
        middle = np.array([x, y]) + place[:, 0, 0] - part.grid.coordinates(np.array(0), np.array(0))
        offset = middle - pad.centre_m
        away = np.array([(doubt * (axis - at) ** 2).sum() for axis, at in zip(place, middle, strict=True)])
        spread = away / count**2 + (EDGE_PX * part.grid.pixel_m) ** 2 / 2
    seen = min(known.sum() / own.sum(), (known & opening).sum() / size)
    return PadPaste(float(seen), volume,
                    {name: Measured(100 * each.value, 100 * each.sigma) for name, each in values.items()}, offset, spread)


def _outlined(grid: BoardGrid, box: tuple[slice, slice], own: np.ndarray, pad: Pad) -> float:
    """Return the area of an opening, pixels, as the outline of paste that fills it is read: medians and interpolation round its corners."""
    row, col = ((np.arange(FINE * (side.stop - side.start)) + 0.5) / FINE - 0.5 + side.start for side in box)
    filled = pad.holds(*grid.coordinates(*np.meshgrid(row, col, indexing="ij"))).reshape(len(own), FINE, -1, FINE).mean(axis=(1, 3))
    read = zoom(np.where(own, median_filter(filled, 3), 0.0), FINE, order=1, mode="nearest", grid_mode=True) > 0.5
    return float(read.sum() / FINE**2) or pad.area_m2 / grid.pixel_m**2


def _bridges(level: HeightMap, openings: np.ndarray, least_m: float) -> list[tuple[int, ...]]:
    """Return the pads, from 0, that pieces of paste connect, by the medians of 3 × 3 pixels; what was not measured connects nothing."""
    pieces, count = label(median_filter(np.where(level.measured, level.height, -np.inf), 3) > least_m, structure=np.ones((3, 3)))
    both = (pieces > 0) & (openings > 0)
    pairs, pixels = np.unique(np.stack([pieces[both], openings[both]]), axis=1, return_counts=True)
    sizes = np.bincount(openings.ravel())
    held = pairs[:, pixels >= np.maximum(LEAST_BRIDGED * sizes[pairs[1]], 2)]
    groups = (held[1, held[0] == piece] - 1 for piece in np.nonzero(np.bincount(held[0], minlength=count + 1) > 1)[0])
    return [tuple(int(pad) for pad in group) for group in groups]
