"""The fragments of a surface: it is cut wherever its normals turn abruptly or contradict each other.

Where one part hides another the normals turn abruptly, as they do at a crease: parts.py tells the two apart. What is held for each cell of
the surface is a few small numbers, since images have tens of millions of pixels.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from kernels.surface.components import join
from kernels.surface.grid import Grid
from kernels.surface.slopes import STEEPEST

LEAST_TURN = np.radians(8.0)
"""Least angle between the normals of two neighbours that may be a break."""
TURN_OF_MEDIAN = 4.0
"""The same in medians of this angle over all neighbours: noise and curvature turn normals everywhere."""
STEADY, REACH = 0.5, 2
"""Part of its turn by which the edges beside an edge must turn alike where a surface is merely round, and how many of them are looked
at: three in line, since the outline of a part may turn twice, at a pixel that shows both sides."""
NECK = 1
"""Pixels beside cut edges that are left out where necks are looked for: an outline is open where both sides happen to share a normal."""
LEAST_TRUST = 0.1
"""Part of its weight below which loops have found that an edge crosses a break."""
LEAST_PART = 48
"""Number of pixels below which a fragment is no part: outlines are lined with pixels that show both sides."""
EDGE_ON = 0.4
"""Cosine between normal and line of sight below which a surface is seen edge on, and does not tell whether it touches its neighbour: an
outline where a smooth surface turns away from the viewer is one of a part. It is taken a pixel beyond the last pixel centre."""
CELLS_AT_ONCE = 1 << 22
"""Cells whose indices and intermediate values are held at one time: they bound the memory."""

Planes = Sequence[np.ndarray]
"""Two or three arrays of one shape."""


class Fragments(NamedTuple):
    """A surface that is cut at all abrupt turns; cells are positions in the flat layout of its grid."""

    label: np.ndarray  # [size] int, the fragment of each cell; -1 outside
    count: int
    first: np.ndarray  # [E] int, left or upper cell of each cut edge
    second: np.ndarray  # [E] int, right or lower cell
    way: np.ndarray  # [E] 1 where the edge leads down, 0 where it leads right
    slope: np.ndarray  # [E] in units of the spacing
    weight: np.ndarray  # [E] that of the edge if it crosses no break
    turn: np.ndarray  # [E] angle between the two normals, radians
    turned: np.ndarray  # [E] bool, whether the normals turn abruptly; else only loops contradict themselves
    jump: np.ndarray  # [E] difference between the slopes of the two normals
    edge_on: np.ndarray  # [E] bool, whether one of the two sides is seen edge on where it ends


def cut(normal: np.ndarray, ray: Planes, slope: Planes, weight: Planes, left: Planes, *, grid: Grid, perspective: bool,
        spacing: float) -> Fragments:
    """Cut a surface wherever its normals turn abruptly or contradict each other around a loop.

    Args:
        normal: [3, rows, cols] camera frame.
        ray: x and y of the pixels in the plane of projection, each [rows, cols].
        slope: of the edges to the right and of those down, each [size], in units of the spacing.
        weight: of these edges before loops are looked at; 0 is no edge.
        left: weights that the loops leave.
        grid: the layout of slope, weight and left.
        perspective: whether slopes are those of -log depth.
        spacing: distance of neighbouring pixels in the plane of x and y.
    """
    n = _unit_cells(normal, grid)
    there = np.stack([plane > 0 for plane in weight])
    turn = [_turn(n, step) for step in (1, grid.pitch)]
    usual = float(np.median(np.concatenate([angle[edges] for angle, edges in zip(turn, there, strict=True)]), overwrite_input=True)) \
        if there.any() else 0.0
    turned = np.stack([edges & (angle > max(LEAST_TURN, TURN_OF_MEDIAN * usual)) for angle, edges in zip(turn, there, strict=True)])
    for way, step in enumerate((1, grid.pitch)):
        abrupt = np.flatnonzero(turned[way])
        turned[way, abrupt[_rounded(n, there[way], abrupt, way, step)]] = False
    del n, turn  # what follows needs them along the cut alone
    lost = turned.copy()
    if turned.any():
        for edges, held, whole, kept in zip(lost, there, weight, left, strict=True):
            edges |= held & (kept < LEAST_TRUST * whole)
    usable = there[0] | there[1]
    usable[1:] |= there[0, :-1]
    usable[grid.pitch :] |= there[1, : -grid.pitch]
    label, count = _part_at_necks(*label_cells(usable, there & ~lost, grid.pitch), there & ~lost, lost, grid.pitch)
    for way, step in enumerate((1, grid.pitch)):
        lost[way, :-step] |= there[way, :-step] & (label[:-step] != label[step:])
    way, first = np.nonzero(lost)
    second = first + np.where(way == 1, grid.pitch, 1)
    step = (_at(ray, second, grid) - _at(ray, first, grid)) / spacing
    sides = _unit_at(normal, first, grid), _unit_at(normal, second, grid)

    def facing(cell: np.ndarray) -> np.ndarray:
        (x, y), n = _at(ray, cell, grid), _unit_at(normal, cell, grid)
        return n[2] - (n[0] * x + n[1] * y) * perspective

    alone = [-(side[:2] * step).sum(axis=0) / np.maximum(facing(cell), STEEPEST) for side, cell in zip(sides, (first, second), strict=True)]
    inward = np.where(way == 1, grid.pitch, 1)
    ends = np.minimum(*(_squared_end(facing(cell), facing(inner), label[inner] == label[cell])
                        for cell, inner in ((first, first - inward), (second, second + inward))))

    def of_edges(planes: Planes) -> np.ndarray:
        return np.where(way == 1, planes[1][first], planes[0][first])

    return Fragments(label, count, first, second, way, of_edges(slope), of_edges(weight),
                     np.arccos(np.clip((sides[0] * sides[1]).sum(axis=0), -1.0, 1.0)), turned[way, first],
                     np.abs(alone[0] - alone[1]), ends < EDGE_ON**2)


def _turn(n: np.ndarray, step: int) -> np.ndarray:
    """Return [size] float32 the angle between the normals of each cell and the cell `step` later; 0 for the last ones."""
    out = np.zeros(n.shape[1], dtype=np.float32)
    inside = out[:-step]
    inside += n[0, :-step] * n[0, step:]
    for plane in n[1:]:
        inside += plane[:-step] * plane[step:]
    np.arccos(np.clip(inside, -1.0, 1.0, out=inside), out=inside)
    return out


def _rounded(n: np.ndarray, there: np.ndarray, edge: np.ndarray, way: int, step: int) -> np.ndarray:
    """Return which of the edges, [E] cells, turn outwards as steadily as their neighbours in line: there a thin rod or ring is round."""
    def change(at: np.ndarray) -> np.ndarray:
        held = (at >= 0) & (at < n.shape[1] - step)
        cell = np.where(held, at, 0)
        return np.where(held & there[cell], n[:, cell + step] - n[:, cell], 0)

    here = change(edge)
    least = STEADY * (here**2).sum(axis=0)
    two_before, before, after, two_after = ((here * change(edge + k * step)).sum(axis=0) > least for k in (-REACH, -1, 1, REACH))
    outwards = here[0] > 0 if way == 0 else here[1] < 0
    return outwards & ((before & two_before) | (before & after) | (after & two_after))


def _squared_end(facing: np.ndarray, facing_inner: np.ndarray, alike: np.ndarray) -> np.ndarray:
    """Return the squared cosine to the viewer a pixel beyond the last cell of a fragment; on a sphere it falls steadily to 0.

    Args:
        facing: cosine at the last cell.
        facing_inner: at the cell before it.
        alike: whether that cell belongs to the same fragment.
    """
    here = np.maximum(facing, 0) ** 2
    return here - np.where(alike, np.maximum(np.maximum(facing_inner, 0) ** 2 - here, 0), 0)


def _part_at_necks(label: np.ndarray, count: int, open_edges: np.ndarray, lost: np.ndarray, pitch: int) -> tuple[np.ndarray, int]:
    """Return the fragments, [size] int with -1 outside, parted where only a neck of few pixels connects them, and their number.

    What is left without the pixels beside lost edges falls apart at necks. Pieces of at least LEAST_PART pixels grow back until they meet.
    """
    if count == 0:
        return label, 0
    near = lost[0] | lost[1]
    near[1:] |= lost[0, :-1]
    near[pitch:] |= lost[1, :-pitch]
    for _ in range(NECK):
        for step in (1, pitch):
            wide = near.copy()
            wide[step:] |= near[:-step]
            wide[:-step] |= near[step:]
            near = wide
    inner = (label >= 0) & ~near
    within = open_edges & inner
    within[0, :-1] &= inner[1:]
    within[1, :-pitch] &= inner[pitch:]
    core, cores = label_cells(inner, within, pitch)
    large = np.bincount(core[core >= 0], minlength=cores) >= LEAST_PART
    seed = np.where((core >= 0) & large[np.maximum(core, 0)], core + count, -1) if cores else core
    seeded = np.zeros(count, dtype=bool)
    seeded[label[seed >= 0]] = True
    grown = np.where((label >= 0) & ~seeded[np.maximum(label, 0)], label, seed)
    front = np.flatnonzero(seed >= 0)
    while len(front):
        reached = []
        for step, ways, back in ((1, 0, 0), (pitch, 1, 0), (1, 0, 1), (pitch, 1, 1)):
            into = front - step if back else front + step
            passed = open_edges[ways, into if back else front] & (grown[into] < 0)
            grown[into[passed]] = grown[front[passed]]
            reached.append(into[passed])
        front = np.unique(np.concatenate(reached))
    kept, number = np.unique(grown[grown >= 0], return_inverse=True)
    out = np.full(label.shape, -1, dtype=np.int32)
    out[grown >= 0] = number
    return out, len(kept)


def label_cells(usable: np.ndarray, open_edges: np.ndarray, pitch: int) -> tuple[np.ndarray, int]:
    """Return the connected parts of a surface, [size] int32 with -1 outside, and their number.

    Args:
        usable: [size] bool.
        open_edges: [2, size] bool, whether the edges to the right and down connect.
        pitch: cells a row.
    """
    begins = usable.copy()
    begins[1:] &= ~open_edges[0, :-1]
    run = np.cumsum(begins, dtype=np.int32)  # runs of cells that are open to the right
    run -= 1
    count = int(run[-1]) + 1 if len(run) else 0
    pairs = np.zeros(0, dtype=np.int64)
    for first in range(0, len(run), CELLS_AT_ONCE):
        upper = first + np.flatnonzero(open_edges[1, first : first + CELLS_AT_ONCE])
        pairs = np.union1d(pairs, run[upper].astype(np.int64) * max(count, 1) + run[upper + pitch])
    kept, of_run = np.unique(join(count, pairs // max(count, 1), pairs % max(count, 1)), return_inverse=True)
    if count == 0:
        return np.full(len(usable), -1, dtype=np.int32), 0
    label = of_run.astype(np.int32)[np.maximum(run, 0, out=run)]
    label[~usable] = -1
    return label, len(kept)


def _unit_cells(normal: np.ndarray, grid: Grid) -> np.ndarray:
    """Return [3, size] float32 unit normals in the flat layout of a grid, 0 outside."""
    out = np.zeros((3, grid.rows + 3, grid.pitch), dtype=np.float32)
    for plane, values in zip(out, normal, strict=True):
        plane[1 : grid.rows + 1, 1 : grid.cols + 1] = np.nan_to_num(values)
    out = out.reshape(3, -1)
    for first in range(0, out.shape[1], CELLS_AT_ONCE):
        cells = out[:, first : first + CELLS_AT_ONCE]
        cells /= np.maximum(np.linalg.norm(cells, axis=0), 1e-9)
    return out


def _unit_at(normal: np.ndarray, cell: np.ndarray, grid: Grid) -> np.ndarray:
    """Return [3, n] float32 unit normals at some cells of a grid; 0 in its padding."""
    n = _at(normal, cell, grid)
    return n / np.maximum(np.linalg.norm(n, axis=0), 1e-9)


def _at(planes: Planes | np.ndarray, cell: np.ndarray, grid: Grid) -> np.ndarray:
    """Return [k, n] float32 planes [rows, cols] at some cells of a grid; 0 in its padding."""
    row, col = cell // grid.pitch - 1, cell % grid.pitch - 1
    inside = (row >= 0) & (row < grid.rows) & (col >= 0) & (col < grid.cols)
    row, col = np.where(inside, row, 0), np.where(inside, col, 0)
    return np.stack([np.where(inside, np.nan_to_num(plane[row, col]), 0) for plane in planes]).astype(np.float32)
