"""The parts of a surface: pixels that are connected across no break, each of which normals place anywhere along the line of sight.

Where one part hides another the normals turn abruptly, as they do at a crease. A loop of slopes around four pixels tells the two apart only
where the outline of the part crosses slopes that the two sides do not share: wherever the outline of a tilted disc before a plane follows
the disc's axis of tilt for two pixels, no loop contradicts itself, and each such place would hold the disc to the plane. So whole outlines
are judged. The surface is cut at all abrupt turns, into fragments that are integrated apart. Two fragments belong together if one shift
makes them meet along most of the edge that they share: this is a crease. If they meet in few places only, or if one is seen edge on along
it, it is a break.

Source: deciding after a first integration which neighbours a surface connects, Durou, Aujol and Courteille, "Integrating the normal field
of a surface in the presence of discontinuities", EMMCVPR 2009; judging whole outlines is ours.
"""

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
MEETING = 0.6
"""Part of the edge between two fragments along which they must meet to belong together."""
PLAY_PIXELS, PLAY_JUMP, PLAY_NOISE = 0.1, 0.6, 3.0
"""Distance within which two sides meet: in pixels; per difference between their slopes, because a crease may pass anywhere between two
pixel centres; and in standard deviations of the noise of the loops."""
DRIFT = 0.015
"""Distance within which two fragments meet, besides, per pixel of the edge that they share: integrated heights drift by about a degree."""
LEAST_PULL = 1e-9
"""Weight, of that of all edges, by which the constant of each part is drawn to 0, so that parts that share no edge have one."""
LIKE_TURN = np.radians(5.0)
"""Angle between normals below which they are alike."""
ROUNDS = 8
"""Most rounds in which small fragments join their neighbours; each at least halves a chain of them."""


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


class Parts(NamedTuple):
    """The parts, and the edges between them."""

    label: np.ndarray  # [size] int, the part of each cell; -1 outside
    count: int
    between: np.ndarray  # [E] bool, whether this cut edge of the fragments leads from part to part


def cut(normal: np.ndarray, ray: np.ndarray, slope: np.ndarray, weight: np.ndarray, left: np.ndarray, *, grid: Grid,
        perspective: bool, spacing: float) -> Fragments:
    """Cut a surface wherever its normals turn abruptly or contradict each other around a loop.

    Args:
        normal: [3, rows, cols] camera frame.
        ray: [2, rows, cols] x and y of the pixels in the plane of projection.
        slope: [2, size] of the edges to the right and down, in units of the spacing.
        weight: [2, size] of these edges before loops are looked at; 0 is no edge.
        left: [2, size] weights that the loops leave.
        grid: the layout of slope, weight and left.
        perspective: whether slopes are those of -log depth.
        spacing: distance of neighbouring pixels in the plane of x and y.
    """
    n = _cells(normal, grid)
    n /= np.maximum(np.linalg.norm(n, axis=0), 1e-9)
    there = weight > 0
    turn = np.zeros(weight.shape, dtype=np.float32)
    for way, step in enumerate((1, grid.pitch)):
        turn[way, :-step] = np.arccos(np.clip((n[:, :-step] * n[:, step:]).sum(axis=0), -1.0, 1.0))
    usual = float(np.median(turn[there])) if there.any() else 0.0
    turned = there & (turn > max(LEAST_TURN, TURN_OF_MEDIAN * usual)) & ~_rounded(n, there, grid.pitch)
    lost = turned | (there & (left < LEAST_TRUST * weight) & turned.any())
    usable = there[0] | there[1]
    usable[1:] |= there[0, :-1]
    usable[grid.pitch :] |= there[1, : -grid.pitch]
    label, count = _part_at_necks(*label_cells(usable, there & ~lost, grid.pitch), there & ~lost, lost, grid.pitch)
    for way, step in enumerate((1, grid.pitch)):
        lost[way, :-step] |= there[way, :-step] & (label[:-step] != label[step:])
    way, first = np.nonzero(lost)
    second = first + np.where(way == 1, grid.pitch, 1)
    xy = _cells(ray, grid)
    step = (xy[:, second] - xy[:, first]) / spacing
    sides = n[:, first], n[:, second]
    facing = n[2] - (n[0] * xy[0] + n[1] * xy[1]) * perspective
    alone = [-(side[:2] * step).sum(axis=0) / np.maximum(facing[cell], STEEPEST) for side, cell in zip(sides, (first, second), strict=True)]
    inward = np.where(way == 1, grid.pitch, 1)
    ends = np.minimum(*(_squared_end(facing, label, cell, cell + inner) for cell, inner in ((first, -inward), (second, inward))))
    return Fragments(label, count, first, second, way, slope[way, first], weight[way, first], turn[way, first],
                     turned[way, first], np.abs(alone[0] - alone[1]), ends < EDGE_ON**2)


def _rounded(n: np.ndarray, there: np.ndarray, pitch: int) -> np.ndarray:
    """Return which edges, [2, size], turn outwards as steadily as their neighbours in line: there a thin rod or ring is round."""
    out = np.zeros(there.shape, dtype=bool)
    for way, step in enumerate((1, pitch)):
        change = np.where(there[way, :-step], n[:, step:] - n[:, :-step], 0)
        least = STEADY * (change**2).sum(axis=0)
        alike = [np.zeros(least.shape, dtype=bool) for _ in range(2 * REACH + 1)]  # of the edges that lie -REACH to REACH farther on
        for k in range(1, REACH + 1):
            near, far = slice(None, -k * step), slice(k * step, None)
            along = (change[:, near] * change[:, far]).sum(axis=0)
            alike[REACH + k][near], alike[REACH - k][far] = along > least[near], along > least[far]
        two_before, before, _, after, two_after = alike
        outwards = change[0] > 0 if way == 0 else change[1] < 0
        out[way, :-step] = outwards & ((before & two_before) | (before & after) | (after & two_after))
    return out


def _squared_end(facing: np.ndarray, label: np.ndarray, cell: np.ndarray, inner: np.ndarray) -> np.ndarray:
    """Return the squared cosine to the viewer a pixel beyond the last cell of a fragment; on a sphere it falls steadily to 0."""
    here = np.maximum(facing[cell], 0) ** 2
    return here - np.where(label[inner] == label[cell], np.maximum(np.maximum(facing[inner], 0) ** 2 - here, 0), 0)


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
    out = np.full(label.shape, -1)
    out[grown >= 0] = number
    return out, len(kept)


def label_cells(usable: np.ndarray, open_edges: np.ndarray, pitch: int) -> tuple[np.ndarray, int]:
    """Return the connected parts of a surface, [size] int with -1 outside, and their number.

    Args:
        usable: [size] bool.
        open_edges: [2, size] bool, whether the edges to the right and down connect.
        pitch: cells a row.
    """
    begins = usable.copy()
    begins[1:] &= ~open_edges[0, :-1]
    run = np.cumsum(begins) - 1  # runs of cells that are open to the right
    count = int(run[-1]) + 1 if len(run) else 0
    upper = np.flatnonzero(open_edges[1])
    pairs = np.unique(run[upper].astype(np.int64) * max(count, 1) + run[upper + pitch])
    kept, of_run = np.unique(join(count, pairs // max(count, 1), pairs % max(count, 1)), return_inverse=True)
    return np.where(usable, of_run[np.maximum(run, 0)] if count else -1, -1), len(kept)


def connect(found: Fragments, height: np.ndarray, *, noise: float) -> Parts:
    """Connect fragments that belong together.

    Args:
        found: the fragments.
        height: [size] heights in units of the spacing, integrated without the cut edges: each fragment has a constant of its own.
        noise: standard deviation of the sum of slopes around four pixels.
    """
    seam = _Seam(found, height)
    for _ in range(ROUNDS):
        if not _join_small(seam):
            break
    play = PLAY_PIXELS + PLAY_JUMP * found.jump + PLAY_NOISE * noise
    for one, other in seam.pairs():
        low, high = sorted((int(seam.group[one]), int(seam.group[other])), key=lambda group: int(seam.size[group]))
        if low != high:
            _join_meeting(seam, low, high, play)
    first, second = seam.sides()
    kept, number = np.unique(seam.group, return_inverse=True)
    return Parts(np.where(found.label >= 0, number[np.maximum(found.label, 0)], -1), len(kept), first != second)


def assemble(found: Fragments, parts: Parts, height: np.ndarray) -> np.ndarray:
    """Return [count] what is to be added to the heights of each part so that parts meet along their common edges in the mean.

    Args:
        found: the fragments.
        parts: into which they were connected.
        height: [size] heights of the parts, each with a constant of its own, in units of the spacing.
    """
    edges = np.flatnonzero(parts.between)
    first, second = parts.label[found.first[edges]], parts.label[found.second[edges]]
    weight = found.weight[edges] / (1 + found.jump[edges] ** 2)
    step = height[found.second[edges]] - height[found.first[edges]] - found.slope[edges]
    matrix, right = np.eye(parts.count) * LEAST_PULL * max(weight.sum(), 1.0), np.zeros(parts.count)
    for one, other, sign in ((first, second, 1.0), (second, first, -1.0)):
        np.add.at(matrix, (one, one), weight)
        np.add.at(matrix, (one, other), -weight)
        np.add.at(right, one, sign * weight * step)
    return np.linalg.solve(matrix, right)


class _Seam:
    """The cut edges, and the groups into which fragments have been joined; a group has the number of one of its fragments."""

    def __init__(self, found: Fragments, height: np.ndarray):
        self.found = found
        self.ends = found.label[found.first], found.label[found.second]
        self.step = height[found.second] - height[found.first] - found.slope
        self.group = np.arange(found.count)
        self.shift = np.zeros(found.count)  # added to the heights of each fragment
        self.size = np.bincount(found.label[found.label >= 0], minlength=found.count)

    def sides(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the groups on both sides of each edge."""
        return self.group[self.ends[0]], self.group[self.ends[1]]

    def rest(self) -> np.ndarray:
        """Return how far the second side of each edge lies in front of where the first leads."""
        return self.step + self.shift[self.ends[1]] - self.shift[self.ends[0]]

    def pairs(self) -> np.ndarray:
        """Return [n, 2] groups that share edges, those with the most edges first."""
        sides = np.sort(np.stack(self.sides()), axis=0)
        between, counts = np.unique(sides[:, sides[0] != sides[1]], axis=1, return_counts=True)
        return between[:, np.argsort(-counts)].T

    def move(self, into: np.ndarray, added: np.ndarray) -> None:
        """Join groups: group g becomes part of into[g] and moves by added[g]; into is larger than g, or g."""
        while True:
            farther = into[into]
            if np.array_equal(farther, into):
                break
            added = added + added[into]
            into = farther
        self.shift += added[self.group]
        self.group = into[self.group]
        self.size = np.bincount(into, weights=self.size, minlength=len(into)).astype(int)


def _join_small(seam: _Seam) -> bool:
    """Join each group too small to be a part to the larger neighbour whose normals are most like its own; return whether there was one."""
    first, second = seam.sides()
    rank = np.empty(len(seam.size), dtype=int)
    rank[np.argsort(seam.size, kind="stable")] = np.arange(len(seam.size))
    parted = first != second
    upward = rank[first] < rank[second]
    small, large = np.where(upward, first, second), np.where(upward, second, first)
    usable = np.flatnonzero(parted & (seam.size[small] < LEAST_PART))
    if not len(usable):
        return False
    likeness = 1 / (LIKE_TURN**2 + seam.found.turn**2)
    pair, of_edge = np.unique(np.stack([small[usable], large[usable]]), axis=1, return_inverse=True)
    total = np.bincount(of_edge.reshape(-1), weights=likeness[usable])
    best = np.lexsort((total, pair[0]))
    best = best[np.append(pair[0][best][1:] != pair[0][best][:-1], True)]  # of each small group the likest neighbour
    inside = np.isin(of_edge.reshape(-1), best)
    edges = usable[inside]
    edges = edges[np.lexsort((likeness[edges], small[edges]))]
    edges = edges[np.append(small[edges][1:] != small[edges][:-1], True)]  # and of their common edges the likest
    into, added = np.arange(len(seam.size)), np.zeros(len(seam.size))
    into[small[edges]] = large[edges]
    added[small[edges]] = np.where(upward[edges], 1, -1) * seam.rest()[edges]
    seam.move(into, added)
    return True


def _join_meeting(seam: _Seam, low: int, high: int, play: np.ndarray) -> None:
    """Join two groups if one shift makes them meet along most of the edge that they share."""
    first, second = seam.sides()
    edges = np.flatnonzero(((first == low) & (second == high)) | ((first == high) & (second == low)))
    telling = edges[~seam.found.edge_on[edges]]
    if len(telling) <= MEETING * len(edges):
        return
    needed = np.where(first[telling] == low, 1, -1) * seam.rest()[telling]
    reach = play[telling] + DRIFT * len(edges)
    bounds = np.concatenate([needed - reach, needed + reach])
    order = np.argsort(bounds, kind="stable")
    met = np.cumsum(np.repeat([1, -1], len(needed))[order])
    most = int(np.argmax(met))
    if met[most] > MEETING * len(edges):
        into, added = np.arange(len(seam.size)), np.zeros(len(seam.size))
        into[low], added[low] = high, 0.5 * (bounds[order[most]] + bounds[order[most + 1]])
        seam.move(into, added)


def _cells(planes: np.ndarray, grid: Grid) -> np.ndarray:
    """Return [k, rows, cols] planes in the flat layout of a grid, [k, size] float32."""
    out = np.zeros((len(planes), grid.rows + 3, grid.pitch), dtype=np.float32)
    out[:, 1 : grid.rows + 1, 1 : grid.cols + 1] = np.nan_to_num(planes)
    return out.reshape(len(planes), -1)

