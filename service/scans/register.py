"""Register a scan set: scan-set.json with the poses and their covariances, and report.json."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from service.errors import RequestError
from service.reporting.progress import Progress, Timings
from service.reporting.provenance import REPORT_FILE, report
from service.requests.register import GivenPoses, RegisterRequest, TableUse
from service.scans.read import read_scans
from stage.errors import ScanError
from stage.files import write_text
from stage.fingerprint import digest
from stage.scans.fixed_poses import FixedPoses, check_fixed
from stage.scans.neighbours import neighbours_are_installed
from stage.scans.pairs import Evidence, Pair, PairState
from stage.scans.pose_graph import REFUSED
from stage.scans.records import SCAN_SET_FILE, ScanEntry, ScanSet, read_scan_set, write_scan_set
from stage.scans.registration import Registration, RegistrationOptions, register
from stage.scans.rigid import about, applied
from stage.scans.scan import Scan
from stage.scans.target_pairs import TargetPlace, target_places
from stage.scans.turntable import turned_pose

LOOSE = 2.0
"""What loops leave, in units of what the pairs say, from which it is said."""
SYSTEMATIC = 3.0
"""Residuals of pairs in units of σ from which it is said."""


class RegisterResult(NamedTuple):
    """The files of a registration, and what its user should know."""

    scan_set_path: Path
    report_path: Path
    joined: int
    """The number of scans that have a pose."""
    scans: int
    residual_m: float | None
    """Median of the residuals of the joined pairs; None: there are none."""
    sigma_m: float | None
    """Largest standard deviation of the place of a scan's middle; None: unknown."""
    sigma_degrees: float | None
    """Largest standard deviation of the rotation of a scan; None: unknown."""
    warnings: tuple[str, ...]


def register_scans(request: RegisterRequest, progress: Progress | None = None) -> RegisterResult:
    """Find the poses of the scans of a set.

    Args:
        request: the set, and how.
        progress: told of every stage.

    Raises:
        RequestError: small_gicp is not installed, or an option does not fit the set.
        ScanError: no two scans can be joined.
        StageError: a file is wrong, damaged or missing.
        StorageError: the results cannot be written.
    """
    if not neighbours_are_installed():
        raise RequestError("scans are registered with small_gicp, which is not installed: pip install 'relit[scans]'")
    timings = Timings(progress)
    file, listed = read_scan_set(request.scan_set)
    reference = _checked(request, file, listed)
    target = request.out / SCAN_SET_FILE
    if target.exists() and target.samefile(file):
        raise RequestError(f"--out {request.out}: would replace {file}, which is registered: give another folder")
    timings.stage("read", len(listed.scans))
    scans = []
    for scan in read_scans(file, listed):
        scans.append(scan)
        timings.advance(len(scans))
    timings.stage("register", 100)
    table = listed.turntable
    if request.turntable is TableUse.FIXED:
        assert table is not None and table.angles_deg is not None
        fixed = check_fixed(scans, [turned_pose(table, angle) for angle in table.angles_deg], threads=_threads(request),
                            advance=timings.advance_percent, cell_m=request.cell_m, least_overlap=request.least_overlap)
        poses, covariances, alone = dict(enumerate(fixed.poses)), {}, {}
        places = target_places({number: scan.targets for number, scan in enumerate(scans)}, poses, {})
        facts, pairs = _fixed_facts(fixed, scans) | _target_facts(places, scans), fixed.pairs
        warnings = _fixed_warnings(fixed, scans) + _wrong_targets(places, scans)
    else:
        options = RegistrationOptions(cell_m=request.cell_m, least_overlap=request.least_overlap, reference=reference,
                                      threads=_threads(request))
        found = register(scans, _starts(request, listed, scans), options, table=table if request.turntable is TableUse.ANGLES else None,
                         advance=timings.advance_percent)
        poses, covariances, alone, pairs = found.poses, found.covariances, found.alone, found.pairs
        facts, warnings = _facts(found, scans), _warnings(found, scans)
    timings.stage("write", 1)
    spread = {number: _spread(scans[number], poses[number], covariance) for number, covariance in covariances.items()}
    entries = [_entry(entry, file.parent, request.out, poses.get(number), covariances.get(number))
               for number, entry in enumerate(listed.scans)]
    joined = [pair for pair in pairs if pair.state is PairState.JOINED and pair.fit is not None]
    report_path = request.out / REPORT_FILE
    write_scan_set(listed.model_copy(update={"scans": tuple(entries)}), target)
    write_text(report_path, report(
        request, inputs={"scan_set": str(file), "name": listed.name, "content": {scan.name: digest(scan.path) for scan in scans}},
        timings_s=timings.close(), **facts, scans=[_scan_facts(number, scan, poses, spread, alone, joined)
                                                   for number, scan in enumerate(scans)],
        pairs=[_pair_facts(pair, scans) for pair in pairs], warnings=warnings))
    return RegisterResult(
        target, report_path, len(poses), len(scans),
        float(np.median([pair.fit.residual for pair in joined if pair.fit is not None])) if joined else None,
        max(size for size, _ in spread.values()) if spread else None, max(turn for _, turn in spread.values()) if spread else None,
        tuple(warnings))


def _threads(request: RegisterRequest) -> int:
    return request.threads or os.cpu_count() or 1


def _checked(request: RegisterRequest, file: Path, listed: ScanSet) -> int | None:
    """Return the number of the reference.

    Raises:
        RequestError, ScanError: an option does not fit the set.
    """
    if request.turntable is not TableUse.START and listed.turntable is None:
        raise RequestError(f"--turntable {request.turntable}: {file} has no turntable")
    if request.turntable is TableUse.FIXED and listed.turntable is not None and listed.turntable.angles_deg is None:
        raise RequestError(f"--turntable fixed: turntable.angles_deg is missing in {file}")
    if len(listed.scans) < 2:
        raise ScanError(f"{file}: scans: holds one scan: two or more are registered")
    if request.reference is None:
        return None
    names = [entry.name for entry in listed.scans]
    if request.reference not in names:
        raise RequestError(f"--reference {request.reference}: is no scan of {file}: they are {', '.join(names[:10])}")
    return names.index(request.reference)


def _starts(request: RegisterRequest, listed: ScanSet, scans: Sequence[Scan]) -> list[np.ndarray | None]:
    """Return the start of each scan: its pose, or else what the angle of the turntable says."""
    if request.poses is GivenPoses.IGNORED:
        return [None] * len(scans)
    table = listed.turntable
    turned = [None] * len(scans) if table is None or table.angles_deg is None else [turned_pose(table, angle) for angle in table.angles_deg]
    if request.turntable is TableUse.ANGLES:
        return list(turned)
    return [scan.pose if scan.pose is not None else start for scan, start in zip(scans, turned, strict=True)]


def _entry(entry: ScanEntry, home: Path, out: Path, pose: np.ndarray | None, covariance: np.ndarray | None) -> ScanEntry:
    """Return the entry of a scan with its pose, and paths relative to the folder of the results."""
    def moved(path: str) -> str:
        return path if Path(path).is_absolute() else Path(os.path.relpath(home / path, out)).as_posix()

    def rows(matrix: np.ndarray | None) -> tuple[tuple[float, ...], ...] | None:
        return None if matrix is None else tuple(tuple(map(float, row)) for row in matrix)

    return entry.model_copy(update={"path": moved(entry.path), "maps": None if entry.maps is None else moved(entry.maps),
                                    "scan_to_world": rows(pose), "pose_covariance": rows(covariance)})


def _spread(scan: Scan, pose: np.ndarray, covariance: np.ndarray) -> tuple[float, float]:
    """Return the standard deviation of the place of the scan's middle, metres, and of its rotation, degrees; roots of sums over axes."""
    shift = about(applied(pose, scan.points.mean(axis=0, dtype=np.float64)[None])[0] - pose[:3, 3])
    own = shift @ covariance @ shift.T
    return float(np.sqrt(max(np.trace(own[3:, 3:]), 0))), float(np.degrees(np.sqrt(max(np.trace(own[:3, :3]), 0))))


def _short(value: float) -> float:
    return float(f"{value:.5g}")


def _facts(found: Registration, scans: Sequence[Scan]) -> dict[str, Any]:
    return {"method": "pairs and pose graph", "reference": scans[found.reference].name, "cell_m": _short(found.cell_m),
            "loop_factor": None if not np.isfinite(found.factor) else _short(found.factor),
            "contradicted_by_loops": [[scans[pair.a].name, scans[pair.b].name] for pair, weight in found.kept if weight <= REFUSED],
            **_target_facts(found.targets, scans)}


def _warnings(found: Registration, scans: Sequence[Scan]) -> list[str]:
    out = [f"{scans[number].name}: has no pose: {words}" for number, words in found.alone.items()]
    for number, scale in found.scales.items():
        out.append(f"{scans[number].name}: is about {abs(scale - 1):.1%} {'larger' if scale > 1 else 'smaller'} than the others: "
                   "check its unit or calibration; poses do not mend a scale")
    for pair, weight in found.kept:
        if weight <= REFUSED:
            out.append(f"{scans[pair.a].name} and {scans[pair.b].name}: the loops through other scans contradict their pose by "
                       f"{pair.by.value}, which counts as nothing")
    out += _target_warnings(found, scans)
    if np.isfinite(found.factor) and found.factor > LOOSE:
        out.append(f"loops leave {found.factor:.3g} times what the noise of the pairs explains: lenses or σ may be wrong; the "
                   "covariances are multiplied by its square")
    surfaces = [pair.fit.ratio for pair, _ in found.kept if pair.fit is not None and pair.by is Evidence.SURFACES]
    if surfaces and (worst := float(np.median(surfaces))) > SYSTEMATIC:
        out.append(f"the surfaces of pairs lie {worst:.3g} times as far apart as σ explains (median): σ is too small, or their points "
                   "are far apart for the bend of the surface")
    single = [number for number in found.poses
              if sum(number in (pair.a, pair.b) for pair, weight in found.kept if weight > REFUSED) == 1]
    if single and len(found.poses) > 2:
        out.append(f"{', '.join(scans[number].name for number in single)}: held by one pair each, which no loop checks")
    return out


def _target_facts(places: Sequence[TargetPlace], scans: Sequence[Scan]) -> dict[str, Any]:
    if not places:
        return {}
    return {"targets": [{
        "name": place.name, "scans": [scans[number].name for number in place.scans],
        "position_m": None if place.position is None else [round(float(x), 7) for x in place.position], "sigma_m": _short(place.sigma_m),
        "elsewhere": {scans[number].name: _short(off) for number, off in place.wrong.items()}} for place in places]}


def _target_warnings(found: Registration, scans: Sequence[Scan]) -> list[str]:
    """Return which pairs their targets do not place, and which targets are not where the others show them."""
    by_targets = [pair for pair in found.pairs if pair.by is Evidence.TARGETS]
    out = [f"{scans[pair.a].name} and {scans[pair.b].name}: {pair.reason}" for pair in by_targets
           if pair.state in (PairState.CONTRADICTED, PairState.MISFIT)]
    for number in found.poses:
        own = [pair for pair in by_targets if number in (pair.a, pair.b)]
        if scans[number].targets and not any(pair.state is not PairState.LITTLE_OVERLAP for pair in own):
            words = max(own, key=lambda pair: pair.overlap).reason if own else "no other scan shows one of them"
            out.append(f"{scans[number].name}: its targets do not place it: {words}")
    return out + _wrong_targets(found.targets, scans)


def _wrong_targets(places: Sequence[TargetPlace], scans: Sequence[Scan]) -> list[str]:
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


def _scan_facts(number: int, scan: Scan, poses: dict[int, np.ndarray], spread: dict[int, tuple[float, float]], alone: dict[int, str],
                joined: Sequence[Pair]) -> dict[str, Any]:
    sigma = spread.get(number)
    return {"name": scan.name, "points": len(scan.points), "sigma_m": _short(float(np.median(scan.sigma))), "sigma": scan.sigma_source,
            "joined": number in poses, "why_not": alone.get(number), "pairs": sum(number in (pair.a, pair.b) for pair in joined),
            "pose_sigma_m": None if sigma is None else _short(sigma[0]), "pose_sigma_degrees": None if sigma is None else _short(sigma[1])}


def _pair_facts(pair: Pair, scans: Sequence[Scan]) -> dict[str, Any]:
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


def _fixed_facts(fixed: FixedPoses, scans: Sequence[Scan]) -> dict[str, Any]:
    return {"method": "fixed turntable", "disagreement": [
        {"scans": [scans[a].name, scans[b].name], "shift_m": _short(shift), "turn_degrees": _short(turn)}
        for (a, b), (shift, turn) in fixed.off.items()]}


def _fixed_warnings(fixed: FixedPoses, scans: Sequence[Scan]) -> list[str]:
    out = []
    if not fixed.off:
        out.append("no pair of scans determines its pose by its surfaces, so that nothing checks the turntable")
    for (a, b), (shift, turn) in fixed.wrong.items():
        out.append(f"{scans[a].name} and {scans[b].name}: their surfaces ask for poses that are {1e3 * shift:.3g} mm and {turn:.3g}° from "
                   "those of the turntable: check its axis and angles")
    return out
