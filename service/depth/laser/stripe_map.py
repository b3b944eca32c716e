"""The depth at pixel centres, from stripe centres that lie between pixels.

A stripe's centre lies up to half a pixel beside the centre of its pixel. On a sloping surface that is another depth, by more than the
centre is uncertain; so the sample is carried to the pixel's centre along the slope to its neighbours in the same line, of other
stripes. The inverse depth is what is linear across a plane, so it is that which is carried.

Curves of one frame that the curves of other frames contradict: they see other depths at the same places, in more light.

A stripe of a plane that nobody declared, or a reflection, gives a surface of its own, which lies before or behind the true one. Where the
declared plane passes over the same pixels in other frames, both cannot be; the fainter one is not the laser's.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from kernels.status import Status
from kernels.structured.stripe import plane_depths
from service.depth.laser.stripe_curves import RIVAL, WHOLE
from stage.capture.camera import Camera
from stage.capture.light import LaserPlane
from stage.results.depth_breaks import same_surface

SLOPE_PX = 32.0
"""Distance up to which a neighbour determines the slope."""
ENOUGH = 100
"""Number of comparisons of stripes below which their order tells nothing."""
JOIN_PX = 2.0
"""Distance of two samples up to which the pixels between them are filled."""


class StripeSamples(NamedTuple):
    """Stripe centres of several frames; `line` is a row and `place` a u, or a column and a v."""

    line: np.ndarray  # [n] int
    place: np.ndarray  # [n] float, continuous image coordinate along the line
    depth: np.ndarray  # [n] float64 metres
    sigma: np.ndarray  # [n] float metres
    amplitude: np.ndarray  # [n] float32
    status: np.ndarray  # [n] uint8, kernels.status.Status

    @classmethod
    def joined(cls, parts: Sequence["StripeSamples"]) -> "StripeSamples":
        """Return the samples of several frames together."""
        return cls(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))

    def where(self, kept: np.ndarray) -> "StripeSamples":
        """Return some of the samples, [n] bool."""
        return StripeSamples(*(values[kept] for values in self))

    def rays(self, camera: Camera, *, along: str, across: float = 0.0, down: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
        """Return where the rays of the stripes meet the plane 1 m away, x and y [n].
        `across`, `down`: pixels by which the image of the stripes lies aside."""
        u, v = (self.place, self.line + 0.5) if along == "row" else (self.line + 0.5, self.place)
        return camera.plane_at(u.astype(np.float64) - across, v.astype(np.float64) - down)

    def depth_change(self, plane: LaserPlane, camera: Camera, *, along: str, across: float = 0.0, down: float = 0.0) -> np.ndarray:
        """Return by how much the depths differ, metres [n], where the stripes are those of a plane, in images that lie aside."""
        x, y = self.rays(camera, along=along, across=across, down=down)
        with np.errstate(invalid="ignore"):
            return np.abs(plane_depths(x, y, np.array(plane.point_m), np.array(plane.normal), along=along).depth - self.depth)

    def widened(self, change_m: np.ndarray) -> "StripeSamples":
        """Return the samples with changes of their depths, metres [n], added to their deviations; NaN adds nothing."""
        return self._replace(sigma=np.where(self.depth > 0, np.hypot(self.sigma, np.nan_to_num(change_m)), self.sigma))


class StripeMap(NamedTuple):
    """Depth at pixel centres, and the samples themselves."""

    depth: np.ndarray  # [rows, cols] float32 metres
    sigma: np.ndarray  # [rows, cols] float32 metres
    amplitude: np.ndarray  # [rows, cols] float32
    solved: np.ndarray  # [rows, cols] bool
    points: np.ndarray  # [n, 3] float64 camera frame, of every sample
    pixels: np.ndarray  # [n, 2] int, row and column of the pixel that holds it


def stripe_map(samples: StripeSamples, shape: tuple[int, ...], camera: Camera, *, along: str) -> StripeMap:
    """Carry samples to pixel centres.
    `samples`: those with status OK are used. `shape`: lines, and pixels of a line. `along`: "row": lines are rows; "column": lines are
    columns."""
    ok = samples.status == Status.OK
    order = np.lexsort((samples.place[ok], samples.line[ok]))
    line, place, depth, sigma, amplitude = (values[ok][order] for values in samples[:5])
    place, inverse = place.astype(np.float64), 1 / depth.astype(np.float64)
    gap = np.diff(place)
    linked = (np.diff(line) == 0) & (gap <= SLOPE_PX) & (gap > 0) & same_surface(depth[:-1], depth[1:], np.maximum(gap, 1.0), camera)
    slope_after = np.where(linked, np.diff(inverse) / np.where(gap > 0, gap, 1), np.nan)
    before, after = np.append(np.nan, slope_after), np.append(slope_after, np.nan)
    slope = _least(before, after)

    out = np.zeros(shape, np.float32)
    spread, bright, solved = np.zeros(shape, np.float32), np.zeros(shape, np.float32), np.zeros(shape, bool)
    # between close neighbours first; then the samples' own pixels, the surest last
    near = np.flatnonzero(linked & (gap <= JOIN_PX))
    first = np.ceil(place[near] - 0.5).astype(int)
    for step in range(int(JOIN_PX) + 1):
        cell = first + step
        inside = (cell + 0.5 <= place[near + 1]) & (cell < shape[1])
        at, here = near[inside], cell[inside]
        part = (here + 0.5 - place[at]) / gap[at]
        out[line[at], here] = 1 / (inverse[at] + part * (inverse[at + 1] - inverse[at]))
        spread[line[at], here] = np.hypot((1 - part) * sigma[at], part * sigma[at + 1])
        bright[line[at], here] = np.maximum(amplitude[at], amplitude[at + 1])
        solved[line[at], here] = True
    cell = np.clip(place.astype(int), 0, shape[1] - 1)
    carried = inverse + slope * (cell + 0.5 - place)
    at = np.argsort(-sigma, kind="stable")
    at = at[~solved[line[at], cell[at]]]
    out[line[at], cell[at]], spread[line[at], cell[at]] = 1 / carried[at], sigma[at]
    bright[line[at], cell[at]], solved[line[at], cell[at]] = amplitude[at], True
    u, v = (place, line + 0.5) if along == "row" else (line + 0.5, place)
    x, y = camera.plane_at(u, v)
    points = np.stack([x * depth, y * depth, -depth], axis=-1)
    if along == "row":
        return StripeMap(out, spread, bright, solved, points, np.stack([line, cell], axis=-1))
    return StripeMap(out.T, spread.T, bright.T, solved.T, points, np.stack([cell, line], axis=-1))


def _least(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Return the slope to carry a sample along: the gentler of the two, 0 where they disagree in sign or neither is known."""
    b, a = np.where(np.isnan(before), after, before), np.where(np.isnan(after), before, after)
    return np.nan_to_num(np.where(a * b > 0, np.sign(a) * np.minimum(np.abs(a), np.abs(b)), 0.0))


REACH_PX = 10.0
"""Distance on a line up to which stripes of two frames are compared."""


def contradicted(samples: StripeSamples, curve: np.ndarray, camera: Camera, *, doubled: bool) -> np.ndarray:
    """Return which samples belong to curves that the curves of other frames contradict, [n] bool.

    A sample is contradicted where the nearest stripe of another frame lies on another surface, and none on either side lies on its own; on
    the edge of a surface one side does. A curve is contradicted where a third of its samples are, by stripes of three times its brightness
    (their median: texture changes single ones). Where frames of the capture show two stripes, stripes of any brightness contradict it; else
    it may see a post that is narrower than the distance of the planes.
    `samples`: of all frames whose stripes cross the same lines; those that are OK are compared. `curve`: [n] int, number of the curve of
    each sample, different for curves of different frames. `doubled`: whether frames of the capture show two stripes."""
    ok = np.flatnonzero(samples.status == Status.OK)
    order = ok[np.lexsort((samples.place[ok], samples.line[ok]))]
    line, place, depth, bright, owner = (values[order] for values in (samples.line, samples.place, samples.depth, samples.amplitude, curve))
    against, beside = np.zeros((2, len(order)), bool), np.zeros((2, len(order)), bool)
    ratio = np.ones((2, len(order)))
    for side, step in enumerate((-1, 1)):
        at = np.arange(len(order))
        other = at + step
        inside = (other >= 0) & (other < len(order))
        other = np.where(inside, other, at)
        gap = np.abs(place[other] - place)
        near = inside & (line[other] == line) & (gap <= REACH_PX) & (owner[other] != owner)
        apart = ~same_surface(depth, depth[other], np.maximum(gap, 1.0), camera)
        against[side], beside[side] = near & apart, near & ~apart
        ratio[side] = np.where(near & apart, bright / np.maximum(bright[other], 1e-30), np.inf)
    alone = against.any(axis=0) & ~beside.any(axis=0)
    found = np.zeros(len(samples.status), bool)
    for number in np.unique(owner[alone]):
        mine = owner == number
        doubted = mine & alone
        if doubted.sum() >= WHOLE * mine.sum() and (doubled or np.median(ratio.min(axis=0)[doubted]) < RIVAL):
            found[order[mine]] = True
    return found


def plane_cuts(samples: StripeSamples, frame: np.ndarray, planes: Sequence[LaserPlane], camera: Camera, *, along: str) -> np.ndarray:
    """Return where the planes of stripes cut their lines at the median depth, along the lines in the plane 1 m away, [n].
    `frame`: [n] int, which of the planes each sample is of."""
    x, y = samples.rays(camera, along=along)
    deep = samples.depth[samples.depth > 0]
    depth = float(np.median(deep)) if deep.size else 1.0
    normal, distance = np.array([plane.normal for plane in planes]), np.array([np.dot(plane.point_m, plane.normal) for plane in planes])
    own, other, across = (0, 1, y) if along == "row" else (1, 0, x)
    with np.errstate(divide="ignore", invalid="ignore"):
        cut = (distance[frame] / depth + normal[frame, 2] - normal[frame, other] * across) / normal[frame, own]
    return np.asarray(cut if along == "row" else -cut)  # v runs down


def concordance(samples: StripeSamples, frame: np.ndarray, planes: Sequence[LaserPlane], camera: Camera, *, along: str) -> float:
    """Return how far stripes move as their planes do, from 1 (all) to -1 (all move the other way); NaN if too few lines tell.

    Compared are the places of stripes on one line, a third of the sweep apart, with those at which their planes cut it at the median depth.
    The relief of the scene shifts stripes by less than that, as a rule.
    `samples`: of all frames whose stripes cross the same lines; those that were found are compared. `frame`: [n] int, the frame of each
    sample. `planes`: of each frame."""
    seen = np.isin(samples.status, (Status.OK, Status.MULTIPATH, Status.OUT_OF_RANGE)) & np.isfinite(samples.place)
    samples = samples.where(seen)
    line, place = samples.line, samples.place
    cut = plane_cuts(samples, frame[seen], planes, camera, along=along)
    signs = []
    for one in np.unique(line):
        here = np.flatnonzero((line == one) & np.isfinite(cut))
        lag = len(here) // 3
        if lag > 0:
            sorted_ = here[np.argsort(cut[here], kind="stable")]
            apart = cut[sorted_[lag:]] > cut[sorted_[:-lag]]
            signs.append(np.sign(place[sorted_[lag:]] - place[sorted_[:-lag]])[apart])
    found = np.concatenate(signs) if signs else np.zeros(0)
    return float(found.mean()) if found.size >= ENOUGH else float("nan")
