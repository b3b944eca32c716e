"""Register a scan set: scan-set.json with the poses and their covariances, and report.json."""

import os
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from service.errors import RequestError
from service.reporting.progress import Progress, Timings
from service.reporting.provenance import REPORT_FILE, report, versions
from service.requests.register import Accepted, GivenPoses, RegisterRequest, TableUse
from service.scans.duplicates import Distinct, distinct
from service.scans.kept_scans import KeptScans, ScanFacts
from service.scans.pieces import FolderPieces, SharedPieces, stamps
from service.scans.points.neighbours import neighbours_are_installed
from service.scans.points.rigid import about, applied
from service.scans.read import given_pose
from service.scans.registration.fixed_poses import check_fixed
from service.scans.registration.pairs import Evidence, Pair, PairState
from service.scans.registration.registration import NoneJoinedError, RegistrationOptions, register_by
from service.scans.registration.target_pairs import target_places
from service.scans.registration_words import (
    PAIRS,
    fixed_facts,
    fixed_warnings,
    pair_facts,
    registration_facts,
    registration_warnings,
    scan_facts,
    target_facts,
    wrong_targets,
)
from stage.errors import ScanError
from stage.files import temporary_folder, write_text
from stage.sets.scan_set import SCAN_SET_FILE, ScanEntry, ScanSet, read_scan_set, rotation_warnings, write_scan_set


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
    scans: Sequence[ScanFacts]
    poses: dict[int, np.ndarray]
    covariances: dict[int, np.ndarray]
    alone: dict[int, str]
    pairs: Sequence[Pair]
    facts: dict[str, Any]
    warnings: list[str]
    refused: NoneJoinedError | None = None
    """Why there are no poses; None: there are."""


def register_scans(request: RegisterRequest, progress: Progress | None = None, sharing: SharedPieces | None = None) -> RegisterResult:
    """Find the poses of the scans of a set. Scans are read one by one; what is kept of them and of pairs lies on the disk.

    Args:
        sharing: the part of this worker in a registration that others help with; None: there are no others.

    Raises:
        RequestError: small_gicp is not installed, or an option does not fit the set.
        ScanError: no two scans can be joined, or the reference cannot; report.json is written all the same.
        StageError: a file is wrong, damaged or missing.
        StorageError: the results cannot be written.
    """
    if not neighbours_are_installed():
        raise RequestError("scans are registered with small_gicp, which is not installed: pip install 'relit[scans]'")
    timings = Timings(progress)
    file, whole = read_scan_set(request.scan_set)
    listed, same_as = alone = distinct(file, whole)
    target = request.out / SCAN_SET_FILE
    if target.exists() and target.samefile(file):
        raise RequestError(f"--out {request.out}: would replace {file}, which is registered: give another folder")
    with _pieces(request, file, listed, sharing) as pieces:
        placed = _placed(request, file, alone, pieces, timings)
    scans, poses, covariances, pairs = placed.scans, placed.poses, placed.covariances, placed.pairs
    timings.stage("write", 1)
    spread = {number: _spread(scans[number], poses[number], covariance) for number, covariance in covariances.items()}
    numbers = {entry.name: number for number, entry in enumerate(listed.scans)}
    entries = [_entry(entry, file.parent, request.out, *(found.get(numbers[same_as.get(entry.name, entry.name)])
                                                         for found in (poses, covariances))) for entry in whole.scans]
    joined = [pair for pair in pairs if pair.state is PairState.JOINED and pair.fit is not None]
    report_path = request.out / REPORT_FILE
    if placed.refused is None:
        write_scan_set(whole.model_copy(update={"scans": tuple(entries)}), target)
    write_text(report_path, report(
        request, inputs={"scan_set": str(file), "name": listed.name, "content": {scan.name: scan.content for scan in scans}},
        timings_s=timings.close(), **placed.facts, duplicates=same_as, scans=[scan_facts(number, scan, poses, spread, placed.alone, joined)
                                                                  for number, scan in enumerate(scans)],
        pairs=[pair_facts(pair, scans) for pair in pairs],
        pairs_not_tried=len(scans) * (len(scans) - 1) // 2 - sum(pair.by is Evidence.SURFACES for pair in pairs), warnings=placed.warnings))
    if placed.refused is not None:
        raise placed.refused
    return RegisterResult(
        target, report_path, len(poses), len(scans),
        float(np.median([pair.fit.residual for pair in joined if pair.fit is not None])) if joined else None,
        max(size for size, _ in spread.values()) if spread else None, max(turn for _, turn in spread.values()) if spread else None,
        tuple(placed.warnings))


def help_register(request: RegisterRequest, progress: Progress, sharing: SharedPieces) -> None:
    """Do pieces of a registration that another worker leads, and write no result."""
    file, whole = read_scan_set(request.scan_set)
    found = distinct(file, whole)
    with _pieces(request, file, found.scans, sharing) as pieces:
        if (refused := _placed(request, file, found, pieces, Timings(progress)).refused) is not None:
            raise refused


@contextmanager
def _pieces(request: RegisterRequest, file: Path, listed: ScanSet, sharing: SharedPieces | None) -> Iterator[SharedPieces]:
    """Return the pieces of a registration: those of its workers, or files of the cache, or of a temporary folder."""
    with ExitStack() as held:
        pieces = sharing
        if pieces is None:
            folder = request.cache or held.enter_context(temporary_folder("register"))
            pieces = SharedPieces(FolderPieces(folder))
        places = [file.parent / path for entry in listed.scans for path in (entry.path, entry.image) if path is not None]
        pieces.identify(listed.model_dump_json(), stamps(places, timed=sharing is None), tuple(versions().items()))
        yield pieces


def _placed(request: RegisterRequest, file: Path, alone: Distinct, pieces: SharedPieces, timings: Timings) -> _Placed:
    listed, reference = alone.scans, _checked(request, file, alone)
    said = alone.warnings() + rotation_warnings(listed)
    table = listed.turntable
    timings.stage("read", len(listed.scans))
    kept = KeptScans(file, listed, pieces, memory_bytes=1e9 * request.memory_gb, threads=request.threads or os.cpu_count() or 1)
    known = kept.facts(request, timings.advance)
    missed, extents = _missed(request, known), [scan.extent_m for scan in known]
    timings.stage("register", 100)
    if request.turntable is TableUse.FIXED:
        assert table is not None and table.angles_deg is not None
        fixed = check_fixed(kept, extents, [table.pose_at(angle) for angle in table.angles_deg], cell_m=request.cell_m,
                            least_overlap=request.least_overlap, advance=timings.advance_percent)
        poses = dict(enumerate(fixed.poses))
        places = target_places({number: scan.targets for number, scan in enumerate(known)}, poses, {})
        return _Placed(known, poses, {}, {}, fixed.pairs, fixed_facts(fixed, known) | target_facts(places, known),
                       said + missed + fixed_warnings(fixed, known) + wrong_targets(places, known))
    options = RegistrationOptions(cell_m=request.cell_m, least_overlap=request.least_overlap, reference=reference,
                                  accept_alike=request.accept is Accepted.LOOK_ALIKE, starts_decide=request.starts)
    said += missed + _without_viewpoint(listed, known)
    starts = _starts(request, listed, [scan.pose for scan in known])
    try:
        found = register_by(kept, [scan.name for scan in known], extents, starts, options,
                            table=table if request.turntable is TableUse.ANGLES else None,
                            targets={number: scan.targets for number, scan in enumerate(known)}, advance=timings.advance_percent)
    except NoneJoinedError as error:
        return _Placed(known, {}, {}, error.alone, error.pairs, {"method": PAIRS}, said, error)
    return _Placed(known, found.poses, found.covariances, found.alone, found.pairs, registration_facts(found, known),
                   said + registration_warnings(found, known, axis_held=request.turntable is TableUse.ANGLES))


def _without_viewpoint(listed: ScanSet, known: list[ScanFacts]) -> list[str]:
    """Return a warning if the origin is taken for the scanner and lies among the points."""
    inside = [scan.name for entry, scan in zip(listed.scans, known, strict=True)
              if entry.viewpoint_m is None and float(np.linalg.norm(scan.middle)) < scan.extent_m / 2]
    return [] if not inside else [
        f"{', '.join(inside)}: viewpoint_m is missing, and the origin, which is taken for the scanner, lies among the points: normals may "
        "look the wrong way; relit import scans estimates where the scanner stood"]


def _missed(request: RegisterRequest, scans: Sequence[ScanFacts]) -> list[str]:
    """Return which scans show none of the marks that were looked for; refuse if none does."""
    if (request.markers is not None or request.board is not None) and not any(scan.found for scan in scans):
        named = [] if request.markers is None else [f"--markers {request.markers}"]
        named += [] if request.board is None else [f"--board {request.board[0]}x{request.board[1]}"]
        raise RequestError(f"{' and '.join(named)}: no scan shows any: {scans[0].name}: {scans[0].missed}")
    return [f"{scan.name}: {scan.missed}" for scan in scans if scan.missed is not None]


def _checked(request: RegisterRequest, file: Path, alone: Distinct) -> int | None:
    """Return the number of the reference, and refuse options that do not fit the set."""
    listed = alone.scans
    if request.turntable is not TableUse.START and listed.turntable is None:
        raise RequestError(f"--turntable {request.turntable}: {file} has no turntable")
    if request.turntable is TableUse.FIXED and listed.turntable is not None and listed.turntable.angles_deg is None:
        raise RequestError(f"--turntable fixed: turntable.angles_deg is missing in {file}")
    if len(listed.scans) < 2:
        beside = f" ({'; '.join(alone.warnings())})" if alone.same_as else ""
        raise ScanError(f"{file}: scans: holds one scan: two or more are registered{beside}")
    if request.starts:
        starts = _starts(request, listed, [given_pose(file, entry) for entry in listed.scans])
        if sum(start is not None for start in starts) < 2:
            raise RequestError(f"--starts: {file} has no two scans with a pose: give scan_to_world, or a turntable with angles_deg")
    if request.reference is None:
        return None
    names = [entry.name for entry in listed.scans]
    reference = alone.same_as.get(request.reference, request.reference)
    if reference not in names:
        raise RequestError(f"--reference {request.reference}: is no scan of {file}: they are {', '.join(names[:10])}")
    return names.index(reference)


def _starts(request: RegisterRequest, listed: ScanSet, poses: Sequence[np.ndarray | None]) -> list[np.ndarray | None]:
    """Return the start of each scan: its pose, or else what the angle of the turntable says."""
    if request.poses is GivenPoses.IGNORED:
        return [None] * len(poses)
    table = listed.turntable
    turned = [None] * len(poses) if table is None or table.angles_deg is None else [table.pose_at(angle) for angle in table.angles_deg]
    if request.turntable is TableUse.ANGLES:
        return list(turned)
    return [start if pose is None else pose for pose, start in zip(poses, turned, strict=True)]


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
