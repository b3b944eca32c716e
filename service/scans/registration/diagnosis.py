"""Why a scan could not be joined, as one that fits mirrored or in another unit, in words; scans whose scale is not that of the others."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from service.scans.points.scan import Scan, Target
from service.scans.registration.pair_tasks import NOT_THERE
from service.scans.registration.pairs import SCALE_LEAST, SCALE_SIGMAS, Pair, PairState, Prepared, prepare, search

FACTORS = {0.001: "as if it were in millimetres", 0.01: "as if it were in centimetres", 0.0254: "as if it were in inches",
           1000.0: "as if the others were in millimetres", 100.0: "as if the others were in centimetres",
           39.37007874: "as if the others were in inches"}
ODD = 8.0
"""A scan whose extent is this many times that of the others, or that part of it, has another unit or shows something else."""
FACTOR_SPAN = 4.0
"""Factor by which the extent of a scan in the right unit may differ from that of the others."""
MOST_TRIED = 24
"""The most scans that a scan is tried against."""


def odd_scans(extents: Sequence[float]) -> set[int]:
    """Return the scans whose extent is far from that of the others."""
    middle = float(np.sort(extents)[(len(extents) - 1) // 2])
    return {number for number, extent in enumerate(extents) if not 1 / ODD < extent / middle < ODD}


def why_alone(scan: Scan, others: Sequence[Callable[[], Prepared]], *, extent: float, others_extent: float, cell_m: float,
              least_overlap: float) -> str | None:
    """Return what makes a scan fit others, as words after its name, or None if neither a mirror nor another unit does.
    `others`: return the scans that could, prepared. `cell_m`: side of the cells of the rough scale, metres."""
    def fits(changed: Scan) -> bool:
        ready = prepare(changed, cell_m=cell_m)
        return any(search(other(), ready, numbers=(0, 1), cell_m=cell_m, least_overlap=least_overlap).state is PairState.JOINED
                   for other in others[:MOST_TRIED])

    ratio = others_extent / extent
    for factor, words in FACTORS.items():
        if 1 / FACTOR_SPAN < ratio / factor < FACTOR_SPAN:
            plain = replace(scan, points=scan.points * np.float32(factor), sigma=scan.sigma * np.float32(factor), camera=None,
                            pixels=None, origin=scan.origin * factor)
            if fits(plain):
                return f"fits the others if its coordinates are multiplied by {factor:g}, {words}: check its unit"
    if not 1 / ODD < ratio < ODD:
        return f"is {extent:.3g} m large, the others about {others_extent:.3g} m: check its unit"
    mirrored = replace(scan, points=scan.points * np.array([-1, 1, 1], dtype=np.float32), camera=None, pixels=None,
                       origin=scan.origin * [-1, 1, 1])
    if fits(mirrored):
        return "fits the others if it is mirrored: check the axes of its coordinates"
    return None


def refusal(number: int, names: Sequence[str], pairs: Iterable[Pair], may_decide: bool) -> str:
    """Return why a scan could not be joined, by the pair that came nearest to it; `may_decide`: it has a start, which does not."""
    own = [pair for pair in pairs if number in (pair.a, pair.b)]
    tried = [pair for pair in own if pair.state is not PairState.NO_POSE]
    if own and all(pair.reason == NOT_THERE for pair in own):
        return "does not overlap the others at the poses that are given"
    if not tried:
        return ("no surface was found that it has in common with the others: it shows another part, too little of the same, or a pattern "
                "that repeats, or its noise is too large")
    ambiguous = [pair for pair in tried if pair.state is PairState.AMBIGUOUS]
    joined = [pair for pair in tried if pair.state is PairState.JOINED]
    best = max(ambiguous or joined or tried, key=lambda pair: pair.overlap)
    other = names[best.b if best.a == number else best.a]
    if best.state is PairState.JOINED:
        return f"is joined with {other} alone, and neither with the largest group of scans"
    advice = {PairState.AMBIGUOUS: ": give its turntable or pose and keep that fixed",
              PairState.CONTRADICTED: ": --starts joins it if its start is right" if may_decide else ""}
    return f"against {other}, {best.reason}{advice.get(best.state, '')}"


def refused_targets(number: int, names: Sequence[str], shown: Mapping[int, Sequence[Target]], pairs: Iterable[Pair]) -> str:
    """Return why the targets of a scan that could not be joined place it against no other, to go behind the reason of its surfaces."""
    tried = [pair for pair in pairs if number in (pair.a, pair.b)]
    if not tried:
        return "; no other scan shows any of its targets" if number in shown else ""
    best = max(tried, key=lambda pair: (pair.fit is not None, pair.overlap))
    return f"; against {names[best.b if best.a == number else best.a]}, {best.reason}" if best.reason else ""


def odd_scales(pairs: Iterable[Pair], numbers: Sequence[int]) -> dict[int, float]:
    """Return the approximate scale of each scan whose scale is not that of the others, by the joined pairs between them alone."""
    place = {number: k for k, number in enumerate(numbers)}
    rows, values = [], []
    for pair in pairs:
        assert pair.fit is not None
        if not np.isfinite(pair.fit.scale_sigma) or pair.fit.scale_sigma <= 0:
            continue
        row = np.zeros(len(numbers))
        row[place[pair.b]], row[place[pair.a]] = 1 / pair.fit.scale_sigma, -1 / pair.fit.scale_sigma
        rows.append(row)
        values.append(-pair.fit.scale / pair.fit.scale_sigma)
    if not rows:
        return {}
    matrix, wanted = np.array(rows), np.array(values)
    inverse = np.linalg.pinv(matrix.T @ matrix, hermitian=True)
    found = inverse @ matrix.T @ wanted
    left = wanted - matrix @ found
    loops = max(len(rows) - len(numbers) + 1, 1)
    spread = np.sqrt(np.diag(inverse)) * max(1.0, float(np.sqrt(left @ left / loops)))
    found -= np.median(found)
    return {number: 1 + float(found[k]) for number, k in place.items()
            if abs(found[k]) > max(SCALE_SIGMAS * float(spread[k]), SCALE_LEAST)}
