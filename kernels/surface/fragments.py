"""The fragments of a surface: it is cut wherever its normals turn abruptly or contradict each other.

Where one part hides another the normals turn abruptly, as they do at a crease: parts.py tells the two apart. What is held for each cell of
the surface is a few small numbers, since images have tens of millions of pixels.
"""

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from kernels.device import to_numpy
from kernels.surface.components import join
from kernels.surface.grid import Grid
from kernels.surface.normal_map import NormalMap, PixelNormals
from kernels.surface.slopes import STEEPEST, pair_turns

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
CELLS_AT_ONCE = 1 << 20
"""Cells whose indices and intermediate values are held at one time: they bound the memory."""

TURNS = 1 << 22
"""Number of edges of each direction, spread over the surface, from which the usual angle is estimated."""

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
    turned: np.ndarray  # [E] bool, whether the normals turn abruptly
    jump: np.ndarray  # [E] difference between the slopes of the two normals
    edge_on: np.ndarray  # [E] bool, whether one of the two sides is seen edge on where it ends
    unlike: np.ndarray  # [E] bool, whether the two sides are of different kinds; where neither, only loops contradict themselves


def cut(surface: NormalMap, kind: np.ndarray | None, slope: Planes, weight: Planes, left: Planes, *, grid: Grid, spacing: float
        ) -> Fragments:
    """Cut a surface wherever its normals turn abruptly or contradict each other around a loop, or its kind [rows, cols] changes.
    `slope`: of the edges to the right and of those down, each [size], in units of the spacing. `weight`: of these edges before loops are
    looked at; 0 is no edge. `left`: weights that the loops leave. `spacing`: distance of neighbouring pixels in the plane of x and y."""
    there = np.stack([plane > 0 for plane in weight])
    usable = there[0] | there[1]
    usable[1:] |= there[0, :-1]
    usable[grid.pitch :] |= there[1, : -grid.pitch]
    turned = _turned(surface, there, grid)
    unlike = _unlike(kind, there, grid)
    lost = turned | unlike
    if lost.any():
        for edges, held, whole, kept in zip(lost, there, weight, left, strict=True):
            for cells in _pieces(len(held)):
                edges[cells] |= held[cells] & (kept[cells] < LEAST_TRUST * whole[cells])
    there &= ~lost
    label, count = label_cells(usable, there, grid.pitch)
    del usable
    if lost.any():  # nothing else makes necks
        label, count = _part_at_necks(label, count, there, lost, grid.pitch)
        for way, step in enumerate((1, grid.pitch)):
            lost[way, :-step] |= there[way, :-step] & (label[:-step] != label[step:])
    del there
    way, first = np.nonzero(lost)
    del lost
    second = first + np.where(way == 1, grid.pitch, 1)
    (sides, rays), ends = zip(*(_at(surface, cell, grid) for cell in (first, second)), strict=True), []
    step = (rays[1] - rays[0]) / spacing
    inward = np.where(way == 1, grid.pitch, 1)
    for side, ray, cell, inner in zip(sides, rays, (first, second), (first - inward, second + inward), strict=True):
        ends.append(_squared_end(_facing(side, ray, surface), _facing(*_at(surface, inner, grid), surface), label[inner] == label[cell]))
    alone = [-(side[:2] * step).sum(axis=0) / np.maximum(_facing(side, ray, surface), STEEPEST)
             for side, ray in zip(sides, rays, strict=True)]

    def of_edges(planes: Planes) -> np.ndarray:
        return np.where(way == 1, planes[1][first], planes[0][first])

    return Fragments(label, count, first, second, way, of_edges(slope), of_edges(weight),
                     np.arccos(np.clip((sides[0] * sides[1]).sum(axis=0), -1.0, 1.0)), turned[way, first],
                     np.abs(alone[0] - alone[1]), np.minimum(*ends) < EDGE_ON**2,
                     unlike[way, first])


def _pieces(count: int) -> Iterator[slice]:
    """Cut cells into pieces that are worked on at one time."""
    return (slice(first, first + CELLS_AT_ONCE) for first in range(0, count, CELLS_AT_ONCE))


def _turned(surface: NormalMap, there: np.ndarray, grid: Grid) -> np.ndarray:
    """Return [2, size] bool, the edges at which the normals turn abruptly, and not as a thin round rod does."""
    turn = [to_numpy(angle) for angle in pair_turns(surface, grid=grid)]
    stride = max(1, grid.size // TURNS)
    while math.gcd(stride, grid.pitch) > 1:  # else a few columns alone would tell
        stride += 1
    some = slice(None, None, stride)
    angles = np.concatenate([angle[some][edges[some]] for angle, edges in zip(turn, there, strict=True)]).astype(np.float32)
    least = max(LEAST_TURN, TURN_OF_MEDIAN * float(np.median(angles, overwrite_input=True))) if len(angles) else LEAST_TURN
    turned = np.stack([edges & (angle > least) for angle, edges in zip(turn, there, strict=True)])
    del turn
    for way, step in enumerate((1, grid.pitch)):
        abrupt = np.flatnonzero(turned[way])
        for piece in _pieces(len(abrupt)):
            cells = abrupt[piece]
            turned[way, cells[_rounded(surface, there[way], cells, way, step, grid)]] = False
    return turned


def _unlike(kind: np.ndarray | None, there: np.ndarray, grid: Grid) -> np.ndarray:
    """Return [2, size] bool, the edges at which the kind changes."""
    found = np.zeros_like(there)
    if kind is not None:
        cells = np.zeros(grid.size, kind.dtype)
        grid.pixels(cells)[:] = kind
        for way, step in enumerate((1, grid.pitch)):
            found[way, :-step] = there[way, :-step] & (cells[:-step] != cells[step:])
    return found


def _rounded(surface: NormalMap, there: np.ndarray, edge: np.ndarray, way: int, step: int, grid: Grid) -> np.ndarray:
    """Return which of the edges, [E] cells, turn outwards as steadily as their neighbours in line: there a thin rod or ring is round."""
    def change(at: np.ndarray) -> np.ndarray:
        held = (at >= 0) & (at < len(there) - step)
        cell = np.where(held, at, 0)
        return np.where(held & there[cell], _at(surface, cell + step, grid)[0] - _at(surface, cell, grid)[0], 0)

    here = change(edge)
    least = STEADY * (here**2).sum(axis=0)
    two_before, before, after, two_after = ((here * change(edge + k * step)).sum(axis=0) > least for k in (-REACH, -1, 1, REACH))
    outwards = here[0] > 0 if way == 0 else here[1] < 0
    return outwards & ((before & two_before) | (before & after) | (after & two_after))


def _at(surface: NormalMap, cell: np.ndarray, grid: Grid) -> PixelNormals:
    """Return the normals at some cells of a grid; 0 in its padding."""
    return surface.at(cell // grid.pitch - 1, cell % grid.pitch - 1)


def _facing(normal: np.ndarray, ray: np.ndarray, surface: NormalMap) -> np.ndarray:
    """Return [n] the component of normals [3, n] along the lines of sight of their pixels, of which the third is 1."""
    return normal[2] - (normal[0] * ray[0] + normal[1] * ray[1]) * surface.perspective


def _squared_end(facing: np.ndarray, facing_inner: np.ndarray, alike: np.ndarray) -> np.ndarray:
    """Return the squared cosine to the viewer a pixel beyond the last cell of a fragment; on a sphere it falls steadily to 0.

    `facing` is the cosine at the last cell, `facing_inner` at the cell before it, `alike` whether that belongs to the same fragment.
    """
    here = np.maximum(facing, 0) ** 2
    return here - np.where(alike, np.maximum(np.maximum(facing_inner, 0) ** 2 - here, 0), 0)


def _part_at_necks(label: np.ndarray, count: int, open_edges: np.ndarray, lost: np.ndarray, pitch: int) -> tuple[np.ndarray, int]:
    """Return the fragments, [size] int32 with -1 outside, parted where only a neck of few pixels connects them, and their number.

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
    grown, cores = label_cells(inner, within, pitch)
    del near, inner, within
    large = np.flatnonzero(sizes_of(grown, cores) >= LEAST_PART)
    kept = np.full(cores + 1, -1, dtype=np.int32)  # the last is for the label -1
    kept[large] = count + np.arange(len(large))
    relabel(grown, kept)
    seeded = np.zeros(count + 1, dtype=bool)
    for cells in _pieces(len(label)):
        seeded[label[cells][grown[cells] >= 0]] = True
    alone = np.where(seeded, -1, np.arange(count + 1)).astype(np.int32)
    alone[count] = -1
    bare = []
    for cells in _pieces(len(label)):
        np.maximum(grown[cells], alone[label[cells]], out=grown[cells])
        bare.append(cells.start + np.flatnonzero((label[cells] >= 0) & (grown[cells] < 0)))
    bare = np.concatenate(bare)
    front = np.unique(np.concatenate([bare + step for step in (1, -1, pitch, -pitch)]))
    front = front[grown[front] >= count]
    while len(front):
        reached = []
        for step, ways, back in ((1, 0, 0), (pitch, 1, 0), (1, 0, 1), (pitch, 1, 1)):
            into = front - step if back else front + step
            passed = open_edges[ways, into if back else front] & (grown[into] < 0)
            grown[into[passed]] = grown[front[passed]]
            reached.append(into[passed])
        front = np.unique(np.concatenate(reached))
    found = sizes_of(grown, count + len(large)) > 0
    relabel(grown, np.append(np.cumsum(found, dtype=np.int32) - 1, np.int32(-1)))
    return grown, int(found.sum())


def sizes_of(label: np.ndarray, count: int) -> np.ndarray:
    """Return [count] the number of cells of each label; a label of -1 is none."""
    return np.sum([np.bincount(label[cells] + 1, minlength=count + 1) for cells in _pieces(len(label))], axis=0)[1:]


def relabel(label: np.ndarray, number: np.ndarray) -> None:
    """Replace each label by its number in place; the last number is that of the label -1."""
    for cells in _pieces(len(label)):
        label[cells] = number[label[cells]]


def label_cells(
    usable: np.ndarray,  # [size] bool
    open_edges: np.ndarray,  # [2, size] bool, whether the edges to the right and down connect
    pitch: int,  # cells a row
) -> tuple[np.ndarray, int]:
    """Return the connected parts of a surface, [size] int32 with -1 outside, and their number."""
    begins = usable.copy()
    begins[1:] &= ~open_edges[0, :-1]
    run = np.cumsum(begins, dtype=np.int32)  # runs of cells that are open to the right
    run -= 1
    count = int(run[-1]) + 1 if len(run) else 0
    pairs = np.zeros(0, dtype=np.int64)
    for cells in _pieces(len(run)):
        upper = cells.start + np.flatnonzero(open_edges[1, cells])
        pairs = np.union1d(pairs, run[upper].astype(np.int64) * max(count, 1) + run[upper + pitch])
    kept, of_run = np.unique(join(count, pairs // max(count, 1), pairs % max(count, 1)), return_inverse=True)
    if count == 0:
        return np.full(len(usable), -1, dtype=np.int32), 0
    relabel(run, np.append(of_run, 0).astype(np.int32))  # cells before the first run are not usable
    run[~usable] = -1
    return run, len(kept)
