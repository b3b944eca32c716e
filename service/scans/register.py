"""Register a scan set: scan-set.json with the poses and their covariances, and report.json."""

import os
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from service.errors import RequestError
from service.reporting.progress import Progress, Timings
from service.reporting.provenance import REPORT_FILE, report, versions
from service.requests.register import GivenPoses, RegisterRequest, TableUse
from service.scans.kept_scans import KeptScans, ScanFacts, facts_of
from service.scans.pieces import FolderPieces, SharedPieces
from service.scans.read import read_scans
from stage.depth_maps import DEPTH_FILE
from stage.errors import ScanError
from stage.files import write_text
from stage.scans.fixed_poses import FixedPoses, check_fixed
from stage.scans.neighbours import neighbours_are_installed
from stage.scans.pairs import Evidence, Pair, PairState
from stage.scans.pose_graph import REFUSED
from stage.scans.records import SCAN_SET_FILE, ScanEntry, ScanSet, read_scan_set, write_scan_set
from stage.scans.registration import Registration, RegistrationOptions, register_by
from stage.scans.rigid import about, applied
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


class _Placed(NamedTuple):
    """Poses, and what there is to say of them."""

    scans: Sequence[ScanFacts]
    poses: dict[int, np.ndarray]
    covariances: dict[int, np.ndarray]
    alone: dict[int, str]
    pairs: Sequence[Pair]
    facts: dict[str, Any]
    warnings: list[str]


def register_scans(request: RegisterRequest, progress: Progress | None = None, sharing: SharedPieces | None = None) -> RegisterResult:
    """Find the poses of the scans of a set. Scans are read one by one; what is kept of them and of pairs lies on the disk.

    Args:
        request: the set, and how.
        progress: told of every stage.
        sharing: the part of this worker in a registration that others help with; None: there are no others.

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
    target = request.out / SCAN_SET_FILE
    if target.exists() and target.samefile(file):
        raise RequestError(f"--out {request.out}: would replace {file}, which is registered: give another folder")
    with _pieces(request, file, listed, sharing) as pieces:
        placed = _placed(request, file, listed, pieces, timings)
    scans, poses, covariances, pairs = placed.scans, placed.poses, placed.covariances, placed.pairs
    timings.stage("write", 1)
    spread = {number: _spread(scans[number], poses[number], covariance) for number, covariance in covariances.items()}
    entries = [_entry(entry, file.parent, request.out, poses.get(number), covariances.get(number))
               for number, entry in enumerate(listed.scans)]
    joined = [pair for pair in pairs if pair.state is PairState.JOINED and pair.fit is not None]
    report_path = request.out / REPORT_FILE
    write_scan_set(listed.model_copy(update={"scans": tuple(entries)}), target)
    write_text(report_path, report(
        request, inputs={"scan_set": str(file), "name": listed.name, "content": {scan.name: scan.content for scan in scans}},
        timings_s=timings.close(), **placed.facts, scans=[_scan_facts(number, scan, poses, spread, placed.alone, joined)
                                                   for number, scan in enumerate(scans)],
        pairs=[_pair_facts(pair, scans) for pair in pairs],
        pairs_not_tried=len(scans) * (len(scans) - 1) // 2 - sum(pair.by is Evidence.SURFACES for pair in pairs), warnings=placed.warnings))
    return RegisterResult(
        target, report_path, len(poses), len(scans),
        float(np.median([pair.fit.residual for pair in joined if pair.fit is not None])) if joined else None,
        max(size for size, _ in spread.values()) if spread else None, max(turn for _, turn in spread.values()) if spread else None,
        tuple(placed.warnings))


def help_register(request: RegisterRequest, progress: Progress, sharing: SharedPieces) -> None:
    """Do pieces of a registration that another worker leads, and write no result.

    Raises:
        DivergedError: this worker finds something else than the worker that leads.
    """
    file, listed = read_scan_set(request.scan_set)
    with _pieces(request, file, listed, sharing) as pieces:
        _placed(request, file, listed, pieces, Timings(progress))


@contextmanager
def _pieces(request: RegisterRequest, file: Path, listed: ScanSet, sharing: SharedPieces | None) -> Iterator[SharedPieces]:
    """Return the pieces of a registration: those of its workers, or files of the cache, or of a temporary folder."""
    with ExitStack() as held:
        pieces = sharing
        if pieces is None:
            folder = request.cache or Path(held.enter_context(tempfile.TemporaryDirectory(prefix="relit-register-")))
            pieces = SharedPieces(FolderPieces(folder))
        places = [file.parent / path for entry in listed.scans for path in (entry.path, entry.image) if path is not None]
        files = [path for place in places for path in (place, place / DEPTH_FILE) if path.is_file()]
        stamps = tuple((path.stat().st_size, 0 if sharing else path.stat().st_mtime_ns) for path in files)
        pieces.identify(listed.model_dump_json(), stamps, tuple(versions().items()))
        yield pieces


def _placed(request: RegisterRequest, file: Path, listed: ScanSet, pieces: SharedPieces, timings: Timings) -> _Placed:
    """Return the poses of the scans of a set."""
    reference = _checked(request, file, listed)
    table, threads = listed.turntable, _threads(request)
    timings.stage("read", len(listed.scans))
    if request.turntable is TableUse.FIXED:
        assert table is not None and table.angles_deg is not None
        scans = []
        for scan in read_scans(file, listed):
            scans.append(scan)
            timings.advance(len(scans))
        timings.stage("register", 100)
        fixed = check_fixed(scans, [turned_pose(table, angle) for angle in table.angles_deg], threads=threads,
                            advance=timings.advance_percent, cell_m=request.cell_m, least_overlap=request.least_overlap)
        known = [facts_of(scan, file, listed, number, request) for number, scan in enumerate(scans)]
        missed = _missed(request, known)
        poses = dict(enumerate(fixed.poses))
        places = target_places({number: scan.targets for number, scan in enumerate(known)}, poses, {})
        return _Placed(known, poses, {}, {}, fixed.pairs, _fixed_facts(fixed, known) | _target_facts(places, known),
                       missed + _fixed_warnings(fixed, known) + _wrong_targets(places, known))
    kept = KeptScans(file, listed, pieces, memory_bytes=1e9 * request.memory_gb, threads=threads)
    known = kept.facts(request, timings.advance)
    missed = _missed(request, known)
    timings.stage("register", 100)
    options = RegistrationOptions(cell_m=request.cell_m, least_overlap=request.least_overlap, reference=reference, threads=threads)
    found = register_by(kept, [scan.name for scan in known], [scan.extent_m for scan in known], _starts(request, listed, known), options,
                        table=table if request.turntable is TableUse.ANGLES else None,
                        targets={number: scan.targets for number, scan in enumerate(known)}, advance=timings.advance_percent)
    return _Placed(known, found.poses, found.covariances, found.alone, found.pairs, _facts(found, known), missed + _warnings(found, known))


def _missed(request: RegisterRequest, scans: Sequence[ScanFacts]) -> list[str]:
    """Return which scans show none of the marks that were looked for.

    Raises:
        RequestError: none does.
    """
    if (request.markers is not None or request.board is not None) and not any(scan.found for scan in scans):
        named = [] if request.markers is None else [f"--markers {request.markers}"]
        named += [] if request.board is None else [f"--board {request.board[0]}x{request.board[1]}"]
        raise RequestError(f"{' and '.join(named)}: no scan shows any: {scans[0].name}: {scans[0].missed}")
    return [f"{scan.name}: {scan.missed}" for scan in scans if scan.missed is not None]


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


def _starts(request: RegisterRequest, listed: ScanSet, scans: Sequence[ScanFacts]) -> list[np.ndarray | None]:
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
                                    "image": None if entry.image is None else moved(entry.image),
                                    "scan_to_world": rows(pose), "pose_covariance": rows(covariance)})


def _spread(scan: ScanFacts, pose: np.ndarray, covariance: np.ndarray) -> tuple[float, float]:
    """Return the standard deviation of the place of the scan's middle, metres, and of its rotation, degrees; roots of sums over axes."""
    shift = about(applied(pose, scan.middle[None])[0] - pose[:3, 3])
    own = shift @ covariance @ shift.T
    return float(np.sqrt(max(np.trace(own[3:, 3:]), 0))), float(np.degrees(np.sqrt(max(np.trace(own[:3, :3]), 0))))


def _short(value: float) -> float:
    return float(f"{value:.5g}")


def _facts(found: Registration, scans: Sequence[ScanFacts]) -> dict[str, Any]:
    return {"method": "pairs and pose graph", "reference": scans[found.reference].name, "cell_m": _short(found.cell_m),
            "loop_factor": None if not np.isfinite(found.factor) else _short(found.factor),
            "contradicted_by_loops": [[scans[pair.a].name, scans[pair.b].name] for pair, weight in found.kept if weight <= REFUSED],
            **_target_facts(found.targets, scans)}


def _warnings(found: Registration, scans: Sequence[ScanFacts]) -> list[str]:
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


def _target_facts(places: Sequence[TargetPlace], scans: Sequence[ScanFacts]) -> dict[str, Any]:
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
    return out + _wrong_targets(found.targets, scans)


def _wrong_targets(places: Sequence[TargetPlace], scans: Sequence[ScanFacts]) -> list[str]:
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


def _scan_facts(number: int, scan: ScanFacts, poses: dict[int, np.ndarray], spread: dict[int, tuple[float, float]], alone: dict[int, str],
                joined: Sequence[Pair]) -> dict[str, Any]:
    sigma = spread.get(number)
    return {"name": scan.name, "points": scan.points, "sigma_m": _short(scan.sigma_m), "sigma": scan.sigma_source,
            "targets": len(scan.targets),
            "joined": number in poses, "why_not": alone.get(number), "pairs": sum(number in (pair.a, pair.b) for pair in joined),
            "pose_sigma_m": None if sigma is None else _short(sigma[0]), "pose_sigma_degrees": None if sigma is None else _short(sigma[1])}


def _pair_facts(pair: Pair, scans: Sequence[ScanFacts]) -> dict[str, Any]:
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


def _fixed_facts(fixed: FixedPoses, scans: Sequence[ScanFacts]) -> dict[str, Any]:
    return {"method": "fixed turntable", "disagreement": [
        {"scans": [scans[a].name, scans[b].name], "shift_m": _short(shift), "turn_degrees": _short(turn)}
        for (a, b), (shift, turn) in fixed.off.items()]}


def _fixed_warnings(fixed: FixedPoses, scans: Sequence[ScanFacts]) -> list[str]:
    out = []
    if not fixed.off:
        out.append("no pair of scans determines its pose by its surfaces, so that nothing checks the turntable")
    for (a, b), (shift, turn) in fixed.wrong.items():
        out.append(f"{scans[a].name} and {scans[b].name}: their surfaces ask for poses that are {1e3 * shift:.3g} mm and {turn:.3g}° from "
                   "those of the turntable: check its axis and angles")
    return out
