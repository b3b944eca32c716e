"""Compose the report of a registration: facts of scans, pairs and targets, and warnings in sentences."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from service.scans.kept_scans import ScanFacts
from service.scans.registration.fixed_poses import FixedPoses
from service.scans.registration.pairs import Evidence, Pair, PairState
from service.scans.registration.pose_graph import REFUSED
from service.scans.registration.registration import Registration
from service.scans.registration.seen_through import doubted_scans
from service.scans.registration.target_pairs import TargetPlace

LOOSE = 2.0
"""Residual of loops, in units of the noise of the pairs, above which the report warns of it."""
SYSTEMATIC = 3.0
"""Residuals of pairs in units of σ from which it is said."""

PAIRS = "pairs and pose graph"
"""The method of a registration by pairs, as the report names it."""


def _short(value: float) -> float:
    return float(f"{value:.5g}")


def registration_facts(found: Registration, scans: Sequence[ScanFacts]) -> dict[str, Any]:
    """Return what the report says of a registration by pairs."""
    return {"method": PAIRS, "reference": scans[found.reference].name, "cell_m": _short(found.cell_m),
            "loop_factor": None if not np.isfinite(found.factor) else _short(found.factor),
            "alike_turned": [scans[number].name for number in found.alike_turned],
            "contradicted_by_loops": [[scans[pair.a].name, scans[pair.b].name] for pair, weight in found.kept if weight <= REFUSED],
            **target_facts(found.targets, scans)}


def registration_warnings(found: Registration, scans: Sequence[ScanFacts], *, axis_held: bool) -> list[str]:
    """Return what the user should know of a registration by pairs; `axis_held`: only the angles of a turntable were to be found."""
    out = [f"{scans[number].name}: has no pose: {words}" for number, words in found.alone.items()]
    for number, scale in found.scales.items():
        out.append(f"{scans[number].name}: is about {abs(scale - 1):.1%} {'larger' if scale > 1 else 'smaller'} than the others: "
                   "check its unit or calibration; poses do not mend a scale")
    for pair, weight in found.kept:
        if weight <= REFUSED:
            out.append(f"{scans[pair.a].name} and {scans[pair.b].name}: the loops through other scans contradict their pose by "
                       f"{pair.by.value}, which counts as nothing")
    out += [f"{scans[pair.a].name} and {scans[pair.b].name}: {pair.reason}" for pair, _ in found.kept
            if pair.reason and pair.by is Evidence.SURFACES]
    if found.alike_turned:
        out.append(f"{', '.join(scans[number].name for number in found.alike_turned)}: look much the same when they are turned about an "
                   "axis: only what sticks out tells their poses from turned ones, which may fit as well and have a small σ: look at the "
                   "result, or give targets, starts or a turntable")
    if doubted := sorted(doubted_scans(found.poses, found.pairs)):
        out.append(f"{', '.join(scans[number].name for number in doubted)}: fit scans that have no pose, from which cameras would see "
                   "through them: the object looks alike turned, and they may be turned too, with a small σ: look at the result, or give "
                   "targets, starts or a turntable")
    out += _target_warnings(found, scans)
    if np.isfinite(found.factor) and found.factor > LOOSE:
        out.append(f"loops leave {found.factor:.3g} times what the noise of the pairs explains: "
                   f"{'the axis of the turntable, ' if axis_held else ''}lenses or σ may be wrong; the covariances are multiplied by its "
                   "square")
    surfaces = [pair.fit.ratio for pair, _ in found.kept if pair.fit is not None and pair.by is Evidence.SURFACES]
    if surfaces and (worst := float(np.median(surfaces))) > SYSTEMATIC:
        out.append(f"the surfaces of pairs lie {worst:.3g} times as far apart as σ explains (median): σ is too small, or their points "
                   "are far apart for the bend of the surface")
    single = [number for number in found.poses
              if sum(number in (pair.a, pair.b) for pair, weight in found.kept if weight > REFUSED) == 1]
    if single and len(found.poses) > 2:
        out.append(f"{', '.join(scans[number].name for number in single)}: held by one pair each, which no loop checks")
    return out


def target_facts(places: Sequence[TargetPlace], scans: Sequence[ScanFacts]) -> dict[str, Any]:
    """Return where each target is, and in which scans it lies elsewhere, metres."""
    if not places:
        return {}
    return {"targets": [{
        "name": place.name, "scans": [scans[number].name for number in place.scans],
        "position_m": None if place.position is None else [round(float(x), 7) for x in place.position], "sigma_m": _short(place.sigma_m),
        "elsewhere": {scans[number].name: _short(off) for number, off in place.wrong.items()}} for place in places]}


def _target_warnings(found: Registration, scans: Sequence[ScanFacts]) -> list[str]:
    """Return which pairs their targets do not place, and which targets are not where the others show them."""
    by_targets = [pair for pair in found.pairs if pair.by is Evidence.TARGETS]
    out = [f"{scans[pair.a].name} and {scans[pair.b].name}: {pair.reason}" for pair in by_targets
           if pair.state in (PairState.CONTRADICTED, PairState.MISFIT)]
    for number in found.poses:
        own = [pair for pair in by_targets if number in (pair.a, pair.b)]
        if scans[number].targets and not any(pair.state is not PairState.LITTLE_OVERLAP for pair in own):
            words = max(own, key=lambda pair: pair.overlap).reason if own else "no other scan shows one of them"
            out.append(f"{scans[number].name}: its targets do not place it: {words}")
    return out + wrong_targets(found.targets, scans)


def wrong_targets(places: Sequence[TargetPlace], scans: Sequence[ScanFacts]) -> list[str]:
    """Return which targets lie elsewhere in some scans than in the others."""
    out = []
    for place in places:
        if place.position is None:
            apart = max(place.wrong.values())
            names = ", ".join(scans[number].name for number in place.wrong)
            out.append(f"target {place.name}: lies up to {1e3 * apart:.3g} mm apart in {names}, and nothing says in which it is right: "
                       "it moved, or has another's name")
            continue
        for number, off in place.wrong.items():
            same = place.same_as.get(number)
            end = "it moved, or has another's name" if same is None else f"that is the place of target {same}: its name is wrong"
            out.append(f"target {place.name}: in {scans[number].name} it lies {1e3 * off:.3g} mm from where the other scans show it: {end}")
    return out


def scan_facts(number: int, scan: ScanFacts, poses: dict[int, np.ndarray], spread: dict[int, tuple[float, float]], alone: dict[int, str],
                joined: Sequence[Pair]) -> dict[str, Any]:
    """Return what the report says of a scan; `spread` is the standard deviation of its place, metres, and rotation, degrees."""
    sigma = spread.get(number)
    return {"name": scan.name, "points": scan.points, "sigma_m": _short(scan.sigma_m), "sigma": scan.sigma_source,
            "targets": len(scan.targets),
            "joined": number in poses, "why_not": alone.get(number), "pairs": sum(number in (pair.a, pair.b) for pair in joined),
            "pose_sigma_m": None if sigma is None else _short(sigma[0]), "pose_sigma_degrees": None if sigma is None else _short(sigma[1])}


def pair_facts(pair: Pair, scans: Sequence[ScanFacts]) -> dict[str, Any]:
    """Return what the report says of a pair."""
    fit = pair.fit
    facts: dict[str, Any] = {"scans": [scans[pair.a].name, scans[pair.b].name], "by": pair.by.value,
                             "state": pair.state.value, "overlap": _short(pair.overlap)}
    if pair.by is Evidence.TARGETS and fit is not None:
        facts |= {"residual_m": _short(fit.residual), "residual_in_sigma": _short(fit.ratio), "targets": fit.matches,
                  "scale": [_short(1 + fit.scale), _short(fit.scale_sigma)]}
    elif fit is not None:
        facts |= {"residual_m": _short(fit.residual), "residual_in_sigma": _short(fit.ratio), "matches": fit.matches,
                  "contradicted": _short(pair.contradicted), "scale": [_short(1 + fit.scale), _short(fit.scale_sigma)]}
    return facts | ({"reason": pair.reason} if pair.reason else {})


def fixed_facts(fixed: FixedPoses, scans: Sequence[ScanFacts]) -> dict[str, Any]:
    """Return by how much pairs disagree with a turntable that was taken as it is."""
    return {"method": "fixed turntable", "disagreement": [
        {"scans": [scans[a].name, scans[b].name], "shift_m": _short(shift), "turn_degrees": _short(turn)}
        for (a, b), (shift, turn) in fixed.off.items()]}


def fixed_warnings(fixed: FixedPoses, scans: Sequence[ScanFacts]) -> list[str]:
    """Return which pairs contradict a turntable that was taken as it is."""
    out = []
    if not fixed.off:
        out.append("no pair of scans determines its pose by its surfaces, so that nothing checks the turntable")
    for (a, b), (shift, turn) in fixed.wrong.items():
        out.append(f"{scans[a].name} and {scans[b].name}: their surfaces ask for poses that are {1e3 * shift:.3g} mm and {turn:.3g}° from "
                   "those of the turntable: check its axis and angles")
    return out
