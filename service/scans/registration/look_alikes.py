"""Scans that look much the same when they are turned about an axis or moved by a period of their pattern, and whether the evidence tells a
pose from the others.

A pose of two such scans is taken if every turned one is refuted: by the free space before either camera, by what sticks out, or by too
little overlap. That one pose matches more of the surface than another is no evidence: it does so where a body is joined to its turned self.
"""

from collections.abc import Iterator

import numpy as np

from service.scans.points.rigid import inverse, moved, screwed, step_between
from service.scans.registration.coarse import is_near
from service.scans.registration.fine import fit
from service.scans.registration.pairs import (
    AS_GOOD,
    KEPT,
    TRIED_POINTS,
    Pair,
    PairState,
    Prepared,
    as_good,
    doubted,
    fits_roughly,
    fitted,
    judged,
    overlap_of,
    same,
    step_units,
)

TURNS_DEG = (-90.0, -60.0, 60.0, 90.0)
"""Turns from which a scan is fitted to itself. A body that its parts tell apart comes back to where it was, or fits badly."""
LEAST_ALIKE = 0.25
"""The least part of a scan that lies on itself after such a turn: half of what is seen leaves the sight of the camera. Of a vase it is .43
and more, of the statue of tests/scenes .28 to .48."""
WEAKEST = 3
"""Directions in which a pose is determined least, along which other poses are looked for near its start: of a plate with a pattern, those
along it and the turn in it."""
START_REACH = 1.25
"""Another pose is as likely as the one that a start led to if it lies at most so many cells from the start, or times as far as that one."""


def looks_alike_turned(scan: Prepared, cell_m: float) -> bool:
    """Return whether a good part of a scan lies on itself after a turn about the axis about which its pose is determined least."""
    return next(_turned_selves(scan, cell_m), None) is not None


def told_from_turned(a: Prepared, b: Prepared, best: Pair, *, cell_m: float, least_overlap: float, accept: bool) -> Pair:
    """Return a joined pair, refused if another pose, by a turn of one scan that looks alike then, passes all tests as well.
    `accept`: take the pair all the same, with a σ that reaches the other pose."""
    if best.state is not PairState.JOINED or best.fit is None:
        return best
    turns = [*_turned_selves(b, cell_m)]
    starts = [best.fit.pose @ turn @ again for turn in turns for again in (np.eye(4), turn)]
    turns = [*_turned_selves(a, cell_m)]
    starts += [inverse(turn @ again) @ best.fit.pose for turn in turns for again in (np.eye(4), turn)]
    for start in starts:
        found = fitted(a, b, start, cell_m)
        if found is None:
            continue
        rival = judged(a, b, found, (best.a, best.b), least_overlap)
        worse = a.image is None and b.image is None and found.ratio > AS_GOOD * best.fit.ratio  # points alone know no free space
        if rival.state is not PairState.JOINED or worse or same(rival, best, b, cell_m):
            continue
        cosine = (np.trace(found.pose[:3, :3] @ best.fit.pose[:3, :3].T) - 1) / 2
        words = (f"it fits as well when it is turned by {np.degrees(np.arccos(np.clip(cosine, -1, 1))):.0f}°, with {rival.overlap:.0%} of "
                 f"the surface matched instead of {best.overlap:.0%}, and nothing that was seen tells which is right")
        if accept:
            apart = step_between(found.pose @ inverse(best.fit.pose), best.fit.pivot)
            return best._replace(fit=doubted(best.fit, apart[None]), reason=words + ": accepted")
        return best._replace(state=PairState.AMBIGUOUS, reason=words)
    return best


def told_from_shifted(a: Prepared, b: Prepared, best: Pair, start: np.ndarray, *, cell_m: float, least_overlap: float, accept: bool
                      ) -> Pair:
    """Return a joined pair, refused if another pose about as near its start, a_from_b [4, 4], fits as well, as where a surface repeats.
    `accept`: take the pair all the same, with a σ that reaches the other pose, or as it is where its start was accepted already."""
    if best.state is not PairState.JOINED or best.fit is None or (accept and best.reason):
        return best
    here, pivot, units = best.fit.pose, best.fit.pivot, step_units(b)

    def apart_m(pose: np.ndarray, other: np.ndarray) -> float:
        return float(np.linalg.norm(step_between(pose @ inverse(other), pivot) / units))

    reach = START_REACH * max(cell_m, apart_m(here, start))
    _, axes = np.linalg.eigh(best.fit.normal * np.outer(units, units))
    for step in (way * units * axis for axis in axes.T[:WEAKEST] for way in (cell_m, -cell_m)):
        for most in (TRIED_POINTS, None):
            found = fitted(a, b, moved(step, pivot, start), cell_m, most)
            if found is None or apart_m(found.pose, here) < KEPT * cell_m or apart_m(found.pose, start) > reach:
                break
        else:
            assert found is not None
            if not as_good(judged(a, b, found, (best.a, best.b), least_overlap), best):
                continue
            words = (f"a pose {1e3 * apart_m(found.pose, here):.3g} mm beside fits as well, and is as near its start: the surface repeats "
                     "itself")
            if accept:
                apart = step_between(found.pose @ inverse(here), pivot)
                return best._replace(fit=doubted(best.fit, apart[None]), reason=words + ": the start is taken, with a σ that reaches it")
            return best._replace(state=PairState.AMBIGUOUS, reason=words)
    return best


def _turned_selves(scan: Prepared, cell_m: float) -> Iterator[np.ndarray]:
    """Yield the motions [4, 4] of a scan in its frame, turns about the axis about which its pose is determined least, after which a good
    part of it lies on itself."""
    here = fit(scan.rough, scan.rough, np.eye(4), [2 * cell_m])
    if here is None:
        return
    units = step_units(scan)
    _, axes = np.linalg.eigh(here.normal * np.outer(units, units))
    twist = units * next(axis for axis in axes.T if np.linalg.norm(axis[:3]) > 0.5)
    for turn in np.radians(TURNS_DEG):
        start = screwed(turn * twist / np.linalg.norm(twist[:3]), here.pivot, np.eye(4))
        found = fit(scan.rough, scan.rough, start, [4 * cell_m, 2 * cell_m])
        if found is None or is_near(found.pose, np.eye(4), scan.rough.middle, cell_m) or not fits_roughly(found, scan, scan, cell_m):
            continue
        if overlap_of(scan, scan, found.pose, cell_m) >= LEAST_ALIKE:
            yield found.pose
