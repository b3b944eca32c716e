"""Registration of two scans: poses that are tried, and whether what they leave is one surface, seen twice, in one way alone."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import NamedTuple

import numpy as np

from service.scans.points.cloud import Cloud, cloud_of, rough_scan, thinned_scan
from service.scans.points.rigid import applied, inverse, moved, step_between
from service.scans.points.scan import Scan
from service.scans.registration.coarse import fpfh, is_near, rough_poses
from service.scans.registration.fine import Fit, Held, fit
from service.scans.registration.free_space import Contradiction, DepthRange, both_sights, contradiction, depth_range
from stage.spread import TUKEY

FEATURE_CELLS = 5.0
"""Radius of the features in cells of the rough clouds, as Open3D's examples have it."""
MOST_POSES = 4
"""The most rough poses of a pair that are refined."""
ROUGH_POINTS, FINE_POINTS = 3000, 12_000
"""The most points of a scan that are matched at either scale."""
CONTRADICTED = 0.1
"""The largest part of the points in sight that may lie where the other camera saw through: borders, mixed pixels, sheets seen edge-on."""
SEEN_THROUGH = 0.002
"""The same of points that belong to a part of the surface which faces the camera: parts that stick out tell a body from its turned self.
Right poses of the statue of tests/scenes leave none to .0007, those that are turned by a quarter or a half .0023 and more."""
STARTED_THROUGH = 0.02
"""The same at a start that decides, which turns no body: there wrong depths, as of bounced light in folds, are the likelier reason. Right
pairs of a path-traced owl under patterns leave up to .007."""
BEFORE_SETS = 0.03
"""The same of points before the surface of a set of points, whose scanner is often known to 20° alone. Right pairs of a real dragon leave
none to .02, with few points and noise too; of wrong ones nearly all leave more, and none that leaves less passes the other tests."""
MATCHED_CONTRADICTED, ROUGH_CONTRADICTED = 0.4, 0.25
"""The same of a pose from matched features, and after its fit at the rough scale."""
BEND = 0.12
"""The largest residual as a part of the spacing of the points, whatever σ is: what the bend of the surface between points makes."""
ROUGH_BEND = 0.15
"""The largest residual of a rough pose in cells: right poses leave .05 of a cell on a statue, wrong ones .3 and more."""
RATIO = 2.5
"""The largest residual in units of σ of scans whose residual is above `BEND`."""
NOT_DETERMINED, WEAK = 4.0, 60.0
"""A direction whose information is less than this many times what the noise of the normals makes alone is not determined, or is tried out.
A vase has up to 4 about its axis; the statue of tests/scenes has 140 and more at overlaps above a tenth."""
BENT, WEAKLY_BENT = 0.18, 1.5
"""The same against what normals make that are as wrong as those of 8 neighbours differ from those of 16: that is too much, but grows with
the spacing of the points and with the bend of the surface, as the error of the normals does. A vase has .06 to .18 about its axis at
spacings of 6 to 20 mm, the statue .5 and more. Edges are left out of the first rule: a courtyard whose points are as far apart as its
details are large has .2 with them and 5 to 50 without, and is tried out for the second."""
FEW_MATCHES, FEW_DETERMINED, FEW_BENT = 200, 10.0, 0.3
"""`NOT_DETERMINED` and `BENT` of a pair with fewer matches than the first number: so few of a stem, joined to its turned self, come
back when they are tried out, as right ones do, and more must speak for each direction."""
TRIED_POINTS = 800
"""The most points of the fit that is first tried out."""
SHIFTS = (0.05, -0.05, 0.1, -0.1, 0.3, -0.3, 0.6, -0.6)
"""Distances, in parts of the size of the scans, by which a scan is moved along a weak direction to try it out. Right pairs of few or noisy
points of a real dragon come back from all; bodies of revolution, balls, pillars and plates stay away at one or another."""
NEAR_SHIFT = 3.0
"""The same from a start, in spacings: a place far from the start is none."""
KEPT, RETURNED = 0.3, 0.02
"""The part of such a shift, and the part of the size, of which the smaller is the most that is left where a scan comes back."""
AS_GOOD, LEAST_ALIKE, MORE_CONTRADICTED = 1.15, 0.6, 0.01
"""Another pose fits as well if its residual is at most this many times that of the best, its overlap at least that part of it, and not
this much more of it is contradicted."""

SCALE_SIGMAS, SCALE_LEAST, SCALE_MOST = 5.0, 0.001, 0.2
"""The scale of a scan is told if it differs from 1 by so many standard deviations and by these parts."""


class PairState(StrEnum):
    """The outcome of registering a pair."""

    JOINED = "joined"
    NO_POSE = "no pose"
    """No pose brings enough of the two surfaces together."""
    LITTLE_OVERLAP = "little overlap"
    MISFIT = "misfit"
    """The surfaces lie further apart than σ and the spacing of the points explain."""
    CONTRADICTED = "contradicted"
    """One scan has points where the camera of the other saw through."""
    AMBIGUOUS = "ambiguous"
    """Several poses fit alike: the surface is symmetric."""


class Evidence(StrEnum):
    """The data from which the pose of a pair was found."""

    SURFACES = "surfaces"
    TARGETS = "targets"


class Pair(NamedTuple):
    """Two scans, and the pose of one against the other."""

    a: int
    b: int
    state: PairState
    fit: Fit | None
    """The best pose and its residuals; None: no pose was found."""
    overlap: float
    """Part of the smaller scan's surface that is matched; by targets, the part of the common ones that keep their distances."""
    contradicted: float
    reason: str
    """The reason why the pair was refused, in words, or what was accepted; empty for other joined pairs."""
    by: Evidence = Evidence.SURFACES


@dataclass(frozen=True, kw_only=True)
class Prepared:
    """A scan at both scales."""

    rough: Cloud
    fine: Cloud
    features: np.ndarray
    image: DepthRange | None
    area: float
    """Area of the surface that is seen, square metres, up to a factor that all scans share."""

    @property
    def spacing(self) -> float:
        """Median distance of neighbouring points of the fine cloud, metres."""
        return float(np.median(self.fine.spacing))


def is_contradicted(found: Contradiction, *, started: bool = False) -> bool:
    """Return whether the free space of two scans refuses a pose; `started`: it was found from a start that decides."""
    through = STARTED_THROUGH if started else SEEN_THROUGH
    return found.points > CONTRADICTED or found.surface > through or found.before_sets > BEFORE_SETS


def prepare(scan: Scan, *, cell_m: float) -> Prepared:
    """Thin a scan to both scales and describe its rough points; cell_m is the side of the cells of the rough scale, metres."""
    thinned = thinned_scan(scan)
    rough = cloud_of(rough_scan(scan, thinned, cell_m), most=ROUGH_POINTS)
    fine = cloud_of(thinned, most=FINE_POINTS)
    return Prepared(rough=rough, fine=fine, features=fpfh(rough, FEATURE_CELLS * cell_m), image=depth_range(scan),
                    area=len(rough.points) * cell_m**2)


def search(a: Prepared, b: Prepared, *, numbers: tuple[int, int], cell_m: float, least_overlap: float) -> Pair:
    """Register two scans, whose numbers are kept in the result, without a start; cell_m is the side of the rough scale's cells, metres."""
    poses = rough_poses(a.rough, b.rough, a.features, b.features, cell_m=cell_m, most=MOST_POSES)
    return _best(a, b, _settled(a, b, poses, cell_m), numbers, cell_m, least_overlap)


def refine(a: Prepared, b: Prepared, start: np.ndarray, *, numbers: tuple[int, int], cell_m: float, least_overlap: float,
           decides: bool = False) -> Pair:
    """Register two scans from a start, a_from_b [4, 4], that is right to about a cell; otherwise as `search`.

    The fine scale is tried at once. The rough scale has few points, and only leads there where the start does not.
    `decides`: whether the start is taken in directions that the surfaces leave open."""
    pair = _best(a, b, iter([start]), numbers, cell_m, least_overlap, start=start, decides=decides)
    if pair.state in (PairState.JOINED, PairState.AMBIGUOUS):
        return pair
    return _best(a, b, _settled(a, b, [start], cell_m), numbers, cell_m, least_overlap, start=start, decides=decides)


def _settled(a: Prepared, b: Prepared, poses: list[np.ndarray], cell_m: float) -> Iterator[np.ndarray]:
    """Yield the poses after a fit at the rough scale, each once, without those that the free space contradicts."""
    seen: list[np.ndarray] = []
    for pose in poses:
        if both_sights(a.image, b.image, a.rough.points, b.rough.points, pose, cell_m).contradicted_part > MATCHED_CONTRADICTED:
            continue
        found = fit(a.rough, b.rough, pose, [4 * cell_m, 2 * cell_m])
        if found is None or any(is_near(found.pose, other, b.rough.middle, cell_m) for other in seen):
            continue
        seen.append(found.pose)
        if not fits_roughly(found, a, b, cell_m):
            continue
        sight = both_sights(a.image, b.image, a.rough.points, b.rough.points, found.pose, cell_m / 2)
        if sight.contradicted_part <= ROUGH_CONTRADICTED:
            yield found.pose


def fits_roughly(found: Fit, a: Prepared, b: Prepared, cell_m: float) -> bool:
    """Return whether a fit at the rough scale leaves no more than the noise and the bend of the surface between points explain."""
    noise = float(np.median(np.hypot(a.rough.sigma.mean(), b.rough.sigma)))
    return found.residual <= max(ROUGH_BEND * cell_m, RATIO * noise)


def _best(a: Prepared, b: Prepared, poses: Iterator[np.ndarray], numbers: tuple[int, int], cell_m: float, least_overlap: float, *,
          start: np.ndarray | None = None, decides: bool = False) -> Pair:
    """Return the best pair of poses that are tried; `start`: the one that is given, so that others far from it are none."""
    found: list[Pair] = []
    for pose in poses:
        settled = fitted(a, b, pose, cell_m)
        pair = None if settled is None else judged(a, b, settled, numbers, least_overlap, started=decides)
        if pair is not None and not any(same(pair, other, b, cell_m) for other in found):
            found.append(pair)
    if not found:
        return Pair(*numbers, PairState.NO_POSE, None, 0.0, 0.0, "no pose brings enough of the two surfaces together")
    found.sort(key=lambda pair: (pair.state is not PairState.JOINED, -pair.overlap))
    best = found[0]
    if best.state is not PairState.JOINED:
        return best
    rival = next((pair for pair in found[1:] if as_good(pair, best)), None)
    if rival is not None:
        return best._replace(state=PairState.AMBIGUOUS, reason="poses that lie apart fit alike: the surface repeats itself")
    return _tried_out(a, b, best, cell_m, least_overlap, start, decides)


def fitted(a: Prepared, b: Prepared, start: np.ndarray, cell_m: float, most: int | None = None, held: Held | None = None
           ) -> Fit | None:
    """Return the fit of so many points at the fine scale from a start; None if there is none."""
    spacing = max(a.spacing, b.spacing)
    return fit(a.fine, b.fine, start, [max(cell_m, 3 * spacing), 3 * spacing, 1.5 * spacing], most=most, held=held)


def judged(a: Prepared, b: Prepared, found: Fit, numbers: tuple[int, int], least_overlap: float, *, started: bool = False) -> Pair:
    """Return the pair at the pose of a fit at the fine scale; `started`: as of `is_contradicted`."""
    spacing = max(a.spacing, b.spacing)
    area = found.matches / len(b.fine.sample) * b.area
    overlap = min(area / min(a.area, b.area), 1.0)
    tolerance = max(TUKEY * found.residual, 0.5 * spacing)
    against = contradiction(a.image, b.image, a.fine, b.fine, found.pose, tolerance)
    state, reason = PairState.JOINED, ""
    if found.residual > BEND * spacing and found.ratio > RATIO:
        state = PairState.MISFIT
        reason = f"the surfaces lie {1e3 * found.residual:.3g} mm apart (standard deviation): {found.ratio:.3g} times what σ explains"
        if SCALE_LEAST < abs(found.scale) < SCALE_MOST and abs(found.scale) > SCALE_SIGMAS * found.scale_sigma:
            reason += f", and one is {abs(found.scale):.2%} larger than the other: check its scale"
    elif is_contradicted(against, started=started):
        state, reason = PairState.CONTRADICTED, _through(against)
    elif overlap < least_overlap:
        state, reason = PairState.LITTLE_OVERLAP, f"only {overlap:.1%} of the smaller surface is matched"
    elif is_contradicted(against):
        reason = f"{_through(against)}: depths there are wrong, or the start is"
    return Pair(*numbers, state, found, overlap, against.points, reason)


def _through(against: Contradiction) -> str:
    return f"{max(against.points, against.before_sets):.1%} of the points in sight lie where the other camera saw through"


def _doubted(a: Prepared, b: Prepared, found: Fit, held: Held | None = None) -> Fit:
    """Return a fit with what another choice of the normals does to its pose, which is about what the spacing of the points does."""
    near_a, near_b = (replace(cloud, normals=cloud.near_normals) for cloud in (a.fine, b.fine))
    other = fit(near_a, near_b, found.pose, [1.5 * max(a.spacing, b.spacing)], held=held)
    return found if other is None else doubted(found, step_between(other.pose @ inverse(found.pose), found.pivot)[None])


def doubted(found: Fit, motions: np.ndarray) -> Fit:
    """Return a fit whose σ holds motions about its pivot, [k, 6], as doubts beside the noise."""
    pull = found.information @ motions.T
    held = pull @ np.linalg.solve(np.eye(len(motions)) + motions @ pull, pull.T)
    return found._replace(doubt=np.concatenate([found.doubt, motions]), information=found.information - held)


def _at_start(a: Prepared, b: Prepared, best: Pair, start: np.ndarray, steps: np.ndarray, cell_m: float, least_overlap: float, words: str
              ) -> Pair:
    """Return the pair as it fits without a motion away from its start in directions that the surfaces leave open, steps [k, 6] of which
    each moves the points by about their size: there its σ is a cell, as near as starts are right."""
    assert best.fit is not None
    held = Held(steps, best.fit.pivot)
    found = fitted(a, b, start, cell_m, held=held)
    if found is None:
        return best._replace(state=PairState.AMBIGUOUS, reason=words)
    pair = judged(a, b, found, (best.a, best.b), least_overlap, started=True)
    if pair.state is not PairState.JOINED:
        return pair
    return pair._replace(fit=doubted(_doubted(a, b, found, held), steps * (cell_m * step_units(b)[0])),
                         reason=f"{words}: its start is taken there, as right to {1e3 * cell_m:.3g} mm")


def _tried_out(a: Prepared, b: Prepared, best: Pair, cell_m: float, least_overlap: float, start: np.ndarray | None, decides: bool) -> Pair:
    """Return the pair, refused if a move along its weakest direction leads to another pose that fits as well, unless the start decides."""
    assert best.fit is not None
    units = step_units(b)
    values, axes = np.linalg.eigh(best.fit.normal * np.outer(units, units))
    near = NEAR_SHIFT * max(a.spacing, b.spacing)
    shifts, reach = ((near * units[0], -near * units[0]), near) if start is not None else (SHIFTS, cell_m)
    undetermined = []
    least, least_bent = (NOT_DETERMINED, BENT) if best.fit.matches >= FEW_MATCHES else (FEW_DETERMINED, FEW_BENT)
    for value, axis in zip(values, axes.T, strict=True):
        noise, bend, even_bend = (float(axis @ (part * np.outer(units, units)) @ axis)
                                  for part in (best.fit.noise, best.fit.bend, best.fit.even_bend))
        step = units * axis / units[0]
        if value < least * noise or value < least_bent * even_bend or ((value < WEAK * noise or value < WEAKLY_BENT * bend) and any(
                _stays_away(a, b, best, shift * step, shift, reach, least_overlap) for shift in shifts)):
            undetermined.append(step)
    if not undetermined:
        return best._replace(fit=_doubted(a, b, best.fit))
    kind = "turned about an axis" if np.linalg.norm(undetermined[0][:3]) > 0.5 else "shifted along itself"
    words = f"the surface looks the same when it is {kind}, so that its pose is not determined"
    if decides and start is not None:
        return _at_start(a, b, best, start, np.array(undetermined), cell_m, least_overlap, words)
    return best._replace(state=PairState.AMBIGUOUS, reason=words)


def overlap_of(a: Prepared, b: Prepared, pose: np.ndarray, near_m: float) -> float:
    """Return which part of the smaller of two scans lies within a distance of the other at a pose a_from_b, facing the same way."""
    placed = applied(pose, b.rough.points)
    index, distance = a.rough.tree.nearest(placed)
    facing = np.einsum("ni,ni->n", b.rough.normals @ pose[:3, :3].T, a.rough.normals[index[:, 0]]) > 0.5
    return float(((distance[:, 0] < near_m) & facing).sum() / min(len(a.rough.points), len(b.rough.points)))


def step_units(scan: Prepared) -> np.ndarray:
    """Return the units of a motion [6] in which a step of length 1 moves the points of a scan by about 1 m."""
    size = float(np.sqrt(((scan.rough.points - scan.rough.middle) ** 2).sum(axis=1).mean()))
    return np.array([1 / size] * 3 + [1.0] * 3)


def _stays_away(a: Prepared, b: Prepared, best: Pair, step: np.ndarray, shift: float, reach: float, least_overlap: float) -> bool:
    """Return whether a fit from a place along a direction, so many sizes of the scans away, does not come back and is as good."""
    assert best.fit is not None
    for most in (TRIED_POINTS, None):
        found = fitted(a, b, moved(step, best.fit.pivot, best.fit.pose), reach, most)
        if found is None:
            return False
        kept = abs(float(step_between(found.pose @ inverse(best.fit.pose), best.fit.pivot) @ step / (step @ step)))
        if kept <= min(KEPT, RETURNED / abs(shift)):
            return False
    assert found is not None
    return as_good(judged(a, b, found, (best.a, best.b), least_overlap), best)


def as_good(pair: Pair, best: Pair) -> bool:
    """Return whether another pose of a pair fits as well as its best one."""
    assert pair.fit is not None and best.fit is not None
    return (pair.state is PairState.JOINED and pair.fit.ratio <= AS_GOOD * best.fit.ratio and pair.overlap >= LEAST_ALIKE * best.overlap
            and pair.contradicted <= best.contradicted + MORE_CONTRADICTED)


def same(pair: Pair, other: Pair, b: Prepared, cell_m: float) -> bool:
    """Return whether the poses of two pairs put scan b in about the same place."""
    assert pair.fit is not None and other.fit is not None
    return is_near(pair.fit.pose, other.fit.pose, b.rough.middle, cell_m)
