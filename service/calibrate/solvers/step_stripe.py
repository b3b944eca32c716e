"""The stripe of a laser on a block that stands on a flat base, split into its lines on base, top and riser."""

import math
from typing import NamedTuple

import numpy as np

from stage.spread import MAD_TO_SIGMA

LEAST_NOISE_PX, LEAST_TOLERANCE_PX, MOST_TOLERANCE_PX = 0.05, 0.3, 1.0
"""The least scatter of a stripe that is taken as its noise; and the least and the largest tolerance of the distance of a point from its
line."""
OUTLIER = 4.0
"""Distance from a line in standard deviations beyond which a point does not belong to it."""
LEAST_END, LEAST_TOP, LEAST_RISER = 8, 12, 5
"""The fewest points of a stripe on the base at either side of the block, on its top and on its riser."""
MOST_TURNED = math.radians(20)
"""Largest angle between the lines on base and top in the image."""
STRAIGHT = 0.7
"""Part of the points on the riser that must lie on one line: the others are where faces meet."""
LEAST_OFFSET_PX = 3.0
"""The least distance between the stripe on the top and that on the base, pixels: less of it tells little of the height."""
TRIALS = 300
"""Pairs of points through which a line is tried."""


class Segment(NamedTuple):
    """The line that a stripe is on one face, as two points that stand for all of its points in a fit of lines."""

    ends: np.ndarray
    """[2, 2] normalised image coordinates, one standard deviation of the points to either side of their middle."""
    weight: float
    """Number of independent points that each of the two stands for."""
    noise: float
    """Standard deviation of one point, in the same coordinates."""
    line: np.ndarray
    """[3] its line, (a, b, c) with a x + b y + c = 0 and a² + b² = 1."""


class StepStripe(NamedTuple):
    """The stripe of one laser plane on a step."""

    base: Segment
    top: Segment
    riser: Segment | None
    """The riser; None where it is hidden, or too short in the image."""
    side: int
    """Order along the stripe: -1 if the riser comes before the top, 1 if behind it."""


def split_stripe(
    x: np.ndarray,  # [n] normalised image coordinates of the points, right
    y: np.ndarray,  # the same, upwards
    order: np.ndarray,  # [n] number of the line of the image that each lies on, ascending
    pixel: float,  # width of a pixel in the same coordinates
) -> StepStripe | None:
    """Return the parts of a stripe on the faces of a block that stands on its base; None if it does not cross base, top and base."""
    points = np.stack([x, y], axis=1)
    if len(points) < 2 * LEAST_END + LEAST_TOP:
        return None
    bends = points[2:] - 2 * points[1:-1] + points[:-2]
    noise = max(MAD_TO_SIGMA * float(np.median(np.linalg.norm(bends, axis=1))) / 6**0.5, LEAST_NOISE_PX * pixel)
    tolerance = float(np.clip(OUTLIER * noise, LEAST_TOLERANCE_PX * pixel, MOST_TOLERANCE_PX * pixel))
    random = np.random.default_rng(0)
    left = np.arange(len(points))
    lines, members = [], []
    for _ in range(3):  # base, top and riser, in the order of their points
        if len(left) < LEAST_TOP:
            break
        line, own = best_line(points[left], tolerance, random)
        if own.sum() < LEAST_TOP:
            break
        lines.append(line)
        members.append(left[own])
        left = left[~own]
    cores = [own[len(own) // 20:len(own) - len(own) // 20] for own in members]  # without points that are on the line by chance
    surrounding = [(base, other) for base in range(len(lines)) for other in range(len(lines)) if other != base
                   and (members[base] < cores[other].min()).sum() >= LEAST_END and (members[base] > cores[other].max()).sum() >= LEAST_END]
    if not surrounding:
        return None
    # of the lines between, that on the top is nearly parallel to the base, as both are in space
    base, top = max(surrounding, key=lambda pair: abs(lines[pair[0]][:2] @ lines[pair[1]][:2]))
    if abs(lines[base][:2] @ lines[top][:2]) < math.cos(MOST_TURNED):
        return None
    first, last = cores[top].min(), cores[top].max()
    members[top] = members[top][(members[top] >= first) & (members[top] <= last)]
    members[base] = members[base][(members[base] < first) | (members[base] > last)]
    offset = np.abs(points[members[top]] @ lines[base][:2] + lines[base][2])
    if np.median(offset) < LEAST_OFFSET_PX * pixel:
        return None
    risers = [_riser(points, order, members[base], members[top], lines[base], lines[top], tolerance, side) for side in (-1, 1)]
    before, behind = (0 if riser is None else len(riser) for riser in risers)
    side, chosen = (-1, risers[0]) if before >= behind else (1, risers[1])
    return StepStripe(_segment(points[members[base]], noise), _segment(points[members[top]], noise),
                      None if chosen is None else _segment(chosen, noise), side)


def best_line(points: np.ndarray, tolerance: float, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return the line through most of the points [n, 2] to within a tolerance, (a, b, c) as of `Segment`, and which points these are, [n]
    bool."""
    first, second = (random.integers(0, len(points), TRIALS) for _ in range(2))
    way = points[second] - points[first]
    length = np.linalg.norm(way, axis=1)
    normal = np.stack([-way[:, 1], way[:, 0]], axis=1)[length > 0] / length[length > 0, None]
    off = np.abs(points @ normal.T - (points[first][length > 0] * normal).sum(axis=1))
    own = off[:, int(np.argmax((off < tolerance).sum(axis=0)))] < tolerance
    for _ in range(3):
        line = _line(points[own])
        near = np.abs(points @ line[:2] + line[2]) < tolerance
        own = near if near.sum() > 2 else own
    return line, own


def _line(points: np.ndarray) -> np.ndarray:
    middle = points.mean(axis=0)
    normal = np.linalg.svd(points - middle, full_matrices=False)[2][-1]
    return np.array([*normal, -normal @ middle])


def _riser(points: np.ndarray, order: np.ndarray, base: np.ndarray, top: np.ndarray, base_line: np.ndarray, top_line: np.ndarray,
           tolerance: float, side: int) -> np.ndarray | None:
    """Return the points of the stripe on the riser at one end of the top; None if it is not seen from its foot to its edge."""
    if side < 0:
        start, stop = base[base < top.min()].max() + 1, top.min()
    else:
        start, stop = top.max() + 1, base[base > top.max()].min()
    between = np.arange(start, stop)
    if len(between) < LEAST_RISER:
        return None
    # from 0 on the base to 1 on the top, both lines with normals to one side
    alike = top_line if base_line[:2] @ top_line[:2] > 0 else -top_line
    of_base, of_top = (points[between] @ line[:2] + line[2] for line in (base_line, alike))
    share = of_base / np.where(of_base == of_top, np.inf, of_base - of_top)
    inner = (share > 0.1) & (share < 0.9) & (np.abs(of_base) > tolerance) & (np.abs(of_top) > tolerance)
    kept = points[between[inner]]
    if len(kept) < LEAST_RISER or share[inner].min() > 0.4 or share[inner].max() < 0.6:
        return None
    lines = order[between[inner]]
    near = np.ones(len(kept), bool)
    for _ in range(3):
        line = _line(kept[near])
        near = np.abs(kept @ line[:2] + line[2]) < tolerance
        if near.sum() < max(LEAST_RISER, STRAIGHT * len(kept)):
            return None
    return kept[near] if np.diff(lines[near]).max() <= LEAST_RISER else None


def _segment(points: np.ndarray, noise: float) -> Segment:
    line = _line(points)
    off = points @ line[:2] + line[2]
    along = np.array([-line[1], line[0]])
    middle = points.mean(axis=0)
    spread = float(((points - middle) @ along).std())
    own = max(noise, float(off.std()))
    return Segment(np.stack([middle - spread * along, middle + spread * along]), len(points) / 2, own, line)
