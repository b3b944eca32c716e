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

from kernels.surface.fragments import LEAST_PART, Fragments, relabel, sizes_of

MEETING = 0.6
"""Part of the edge between two fragments along which they must meet to belong together."""
WHOLE = 0.75
"""Part of its whole outline along which the smaller of two fragments must meet its neighbours, each shifted as fits it."""
PLAY_PIXELS, PLAY_JUMP, PLAY_NOISE = 0.1, 0.6, 3.0
"""Distance within which two sides meet: in pixels; per difference between their slopes, because a crease may pass anywhere between two
pixel centres; and in standard deviations of the noise of the loops."""
DRIFT = 0.015
"""Distance within which two fragments meet, besides, per pixel of the edge that they share: integrated heights drift by about a degree."""
LEAST_PULL = 1e-9
"""Weight, of that of all edges, by which the constant of each part is drawn to 0, so that parts that share no edge have one."""
LIKE_TURN = np.radians(5.0)
"""Angle between normals below which they are alike."""
UNLIKE_TURN = np.radians(25.0)
"""Angle by which normals turn along most of the edge between two kinds of material, as of metal and paint, from which on these are apart,
however well they meet: an inlay, a stripe and a gilded rim go on as the surface does."""
SLIVER_PIXELS = 3.0
"""Mean width of a fragment below which it may be one of mixed pixels along an outline: twice its pixels over its cut edges."""
SURROUNDED = 0.8
"""Part of the outline of a strip that one neighbour has where it does not lie between two parts: a wire, or a groove."""
ROUNDS = 8
"""Most rounds in which small fragments join their neighbours; each at least halves a chain of them."""


class Parts(NamedTuple):
    """The parts, and the edges between them."""

    fragment: np.ndarray  # [size] int, the fragment of each cell, -1 outside: that of `Fragments`, with the small ones and strips joined
    of_fragment: np.ndarray  # [fragments] int, the part that each belongs to
    count: int
    between: np.ndarray  # [E] bool, whether this cut edge of the fragments leads from part to part


def connect(found: Fragments, height: np.ndarray, *, noise: float) -> Parts:
    """Connect fragments that belong together; those under LEAST_PART pixels and strips along outlines lose their labels.
    `height`: [size] heights in units of the spacing, integrated without the cut edges: each fragment has a constant of its own. `noise`:
    standard deviation of the sum of slopes around four pixels."""
    seam = _Seam(found, height)
    for _ in range(ROUNDS):
        if not _absorb(seam, seam.size < LEAST_PART):
            break
    for _ in range(ROUNDS):
        if not _absorb(seam, _slivers(seam)):
            break
    kept, fragment = np.unique(seam.group, return_inverse=True)
    relabel(found.label, np.append(fragment, -1).astype(np.int32))
    play = PLAY_PIXELS + PLAY_JUMP * found.jump + PLAY_NOISE * noise
    for one, other in seam.pairs():
        low, high = sorted((int(seam.group[one]), int(seam.group[other])), key=lambda group: int(seam.size[group]))
        if low != high:
            _join_meeting(seam, low, high, play)
    first, second = seam.sides()
    groups, part = np.unique(seam.group, return_inverse=True)
    return Parts(found.label, part[kept].astype(np.int32), len(groups), first != second)


def assemble(found: Fragments, parts: Parts, height: np.ndarray) -> np.ndarray:
    """Return [count] what is to be added to the heights of each part so that parts meet along their common edges in the mean.

    `height` is [size] heights of the parts, each with a constant of its own, in units of the spacing.
    """
    edges = np.flatnonzero(parts.between)
    first, second = (parts.of_fragment[parts.fragment[cells[edges]]] for cells in (found.first, found.second))
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
        self.size = sizes_of(found.label, found.count)

    def sides(self, edges: np.ndarray | slice = slice(None)) -> tuple[np.ndarray, np.ndarray]:
        """Return the groups on both sides of edges."""
        return self.group[self.ends[0][edges]], self.group[self.ends[1][edges]]

    def rest(self, edges: np.ndarray) -> np.ndarray:
        """Return how far the second side of edges lies in front of where the first leads."""
        return self.step[edges] + self.shift[self.ends[1][edges]] - self.shift[self.ends[0][edges]]

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


def _slivers(seam: _Seam) -> np.ndarray:
    """Return [groups] whether each is a strip along an outline: thin, and between others of which none surrounds it."""
    pair, shared = np.unique(np.stack([np.concatenate(seam.sides()), np.concatenate(seam.sides()[::-1])]), axis=1, return_counts=True)
    shared = np.where(pair[0] != pair[1], shared, 0)
    outline, longest = np.zeros(len(seam.size), dtype=int), np.zeros(len(seam.size), dtype=int)
    np.add.at(outline, pair[0], shared)
    np.maximum.at(longest, pair[0], shared)
    return (2 * seam.size < SLIVER_PIXELS * outline) & (longest < SURROUNDED * outline)


def _absorb(seam: _Seam, little: np.ndarray) -> bool:
    """Join each group that is `little` [groups] to the larger neighbour whose normals are most like its own; return whether there was
    one."""
    first, second = seam.sides()
    rank = np.empty(len(seam.size), dtype=int)
    rank[np.argsort(seam.size, kind="stable")] = np.arange(len(seam.size))
    parted = first != second
    upward = rank[first] < rank[second]
    small, large = np.where(upward, first, second), np.where(upward, second, first)
    usable = np.flatnonzero(parted & little[small])
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
    added[small[edges]] = np.where(upward[edges], 1, -1) * seam.rest(edges)
    seam.move(into, added)
    return True


def _join_meeting(seam: _Seam, low: int, high: int, play: np.ndarray) -> None:
    """Join two groups if one shift makes them meet along most of the edge that they share, and the smaller one meets its neighbours along
    most of its whole outline: a short stretch of an outline meets whatever lies behind it."""
    first, second = seam.sides()
    shared = ((first == low) & (second == high)) | ((first == high) & (second == low))
    if 2 * np.count_nonzero((seam.found.unlike & (seam.found.turn > UNLIKE_TURN))[shared]) > np.count_nonzero(shared):
        return
    outline = np.flatnonzero(((first == low) | (second == low)) & (first != second))
    other = np.where(first[outline] == low, second[outline], first[outline])
    met, shift = _met(seam, low, outline[other == high], play)
    if met <= MEETING * np.count_nonzero(other == high):
        return
    if sum(_met(seam, low, outline[other == each], play)[0] for each in np.unique(other)) > WHOLE * len(outline):
        into, added = np.arange(len(seam.size)), np.zeros(len(seam.size))
        into[low], added[low] = high, shift
        seam.move(into, added)


def _met(seam: _Seam, low: int, edges: np.ndarray, play: np.ndarray) -> tuple[int, float]:
    """Return at how many edges between a group and another the shift that is best makes them meet, and that shift of the group."""
    found = seam.found
    telling = edges[~found.edge_on[edges] | (found.unlike & ~found.turned)[edges]]  # an inlay near a rim goes on as the surface does
    if len(telling) <= MEETING * len(edges):
        return 0, 0.0
    needed = np.where(seam.sides(telling)[0] == low, 1, -1) * seam.rest(telling)
    reach = play[telling] + DRIFT * len(edges)
    bounds = np.concatenate([needed - reach, needed + reach])
    order = np.argsort(bounds, kind="stable")
    met = np.cumsum(np.repeat([1, -1], len(needed))[order])
    most = int(np.argmax(met))
    return int(met[most]), float(0.5 * (bounds[order[most]] + bounds[order[most + 1]]))
