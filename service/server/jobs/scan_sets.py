"""Scan sets of jobs: the depths of other jobs, which scan-set.json names by the identifiers of these."""

import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from service.reporting.progress import Progress
from service.reporting.provenance import name_place
from service.requests.jobs import FuseJob, RegisterJob
from stage.scans.records import SCAN_SET_FILE, ScanEntry, ScanSet, read_scan_set, write_scan_set

if TYPE_CHECKING:
    from service.requests.fuse import FuseRequest
    from service.scans.pieces import SharedPieces

PlaceOf = Callable[[str], Path]
"""Returns the folder of this machine with the results of a job, by its identifier."""


def register(request: RegisterJob, name: str, out: Path, place_of: PlaceOf, progress: Progress, sharing: "SharedPieces") -> None:
    """Find the poses of the depths of other jobs.

    Args:
        request: names the depths.
        name: identifier of this job.
        out: folder of its results; its scan-set.json names the jobs, not their folders.
        place_of: where the results of these jobs are.
        progress: told of every stage.
        sharing: the part of this worker.
    """
    from service.requests.register import RegisterRequest
    from service.scans.register import register_scans

    scans = _listed(request, name)
    with _in_folder(scans, place_of, name) as folder:
        done = register_scans(RegisterRequest(scan_set=folder, out=out, **dict(request.options)), progress, sharing)
    _, found = read_scan_set(done.scan_set_path)
    named = {entry.name: entry for entry in scans.scans}
    write_scan_set(found.model_copy(update={"scans": tuple(
        entry.model_copy(update={"path": entry.name, "maps": named[entry.name].maps}) for entry in found.scans)}), done.scan_set_path)


def help_register(request: RegisterJob, name: str, out: Path, place_of: PlaceOf, progress: Progress, sharing: "SharedPieces") -> None:
    """Do pieces of a registration that another worker leads; arguments as of `register`."""
    from service.requests.register import RegisterRequest
    from service.scans import register as product

    with _in_folder(_listed(request, name), place_of, name) as folder:
        product.help_register(RegisterRequest(scan_set=folder, out=out, **dict(request.options)), progress, sharing)


def _listed(request: RegisterJob, name: str) -> ScanSet:
    """Return the scan set of a job, whose paths are identifiers of jobs."""
    maps: tuple[str | None, ...] = request.solves or (None,) * len(request.depths)
    return ScanSet(schema="relit.scan-set/1", name=request.name or name, scans=tuple(
        ScanEntry(name=depth, path=depth, maps=solve) for depth, solve in zip(request.depths, maps, strict=True)))


def fuse(request: FuseJob, out: Path, place_of: PlaceOf, device: str, progress: Progress, sharing: "SharedPieces") -> None:
    """Fuse the depths that another job has registered.

    Args:
        request: names that job.
        out: folder of the results.
        place_of: where the results of that job, and of those that it names, are.
        device: to compute on.
        progress: told of every stage.
        sharing: the part of this worker.
    """
    from service.scans.fuse import fuse as fuse_scans

    with _registered(request, out, place_of, device) as given:
        fuse_scans(given, progress, sharing)


def help_fuse(request: FuseJob, out: Path, place_of: PlaceOf, device: str, progress: Progress, sharing: "SharedPieces") -> None:
    """Do pieces of a fusion that another worker leads; arguments as of `fuse`."""
    from service.scans import fuse as product

    with _registered(request, out, place_of, device) as given:
        product.help_fuse(given, progress, sharing)


@contextmanager
def _registered(request: FuseJob, out: Path, place_of: PlaceOf, device: str) -> Iterator["FuseRequest"]:
    """Yield the request that fuses the scans of a registration."""
    from service.requests.fuse import FuseRequest

    _, scans = read_scan_set(place_of(request.registered) / SCAN_SET_FILE)
    with _in_folder(scans, place_of, request.registered) as folder:
        yield FuseRequest(scan_set=folder, out=out, device=device, **dict(request.options))


@contextmanager
def _in_folder(scans: ScanSet, place_of: PlaceOf, name: str) -> Iterator[Path]:
    """Make a folder with a scan-set.json and, beside it, links to the results of the jobs that its paths name."""
    with tempfile.TemporaryDirectory(prefix="relit-scans-") as made:
        folder = Path(made)
        name_place(folder, name)
        for job in {path for entry in scans.scans for path in (entry.path, entry.maps) if path is not None}:
            (folder / job).symlink_to(place_of(job), target_is_directory=True)
        write_scan_set(scans, folder / SCAN_SET_FILE)
        yield folder
