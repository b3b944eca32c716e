"""Jobs on many scans, of which several workers do pieces: registration and fusion.

Their scan sets name the depths of other jobs by the identifiers of these, which are no folders: a step makes a folder with links.
"""

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from service.reporting.progress import Progress
from service.reporting.provenance import name_place
from service.requests.jobs import FuseJob, RegisterJob
from service.server.jobs.context import Job, JobStep, WorkerContext
from service.server.jobs.pieces import JobPieces
from service.server.jobs.places import StepFiles
from stage.sets.scan_set import SCAN_SET_FILE, ScanEntry, ScanSet, read_scan_set, write_scan_set

if TYPE_CHECKING:
    from service.scans.pieces import SharedPieces


def step_of(job: Job, request: RegisterJob | FuseJob, context: WorkerContext) -> JobStep:
    """Return the step of a job."""
    def do(progress: Progress, *, leads: bool) -> None:
        from service.scans.pieces import SharedPieces

        pieces = JobPieces(context, job)
        files = StepFiles(job, context, progress)
        sharing = SharedPieces(pieces, leads=True, invite=pieces.invite) if leads else SharedPieces(pieces, leads=False)
        if isinstance(request, RegisterJob):
            _register(request, files, sharing)
        else:
            _fuse(request, files, sharing)
        if leads:
            pieces.remove()

    return JobStep(request.kind, partial(do, leads=True), help=partial(do, leads=False))


def _register(request: RegisterJob, files: StepFiles, sharing: "SharedPieces") -> None:
    """Find the poses of the depths of other jobs; the scan-set.json among the results names the jobs, not their folders."""
    from service.requests.register import RegisterRequest
    from service.scans.register import help_register, register_scans

    maps: tuple[str | None, ...] = request.solves or (None,) * len(request.depths)
    scans = ScanSet(schema="relit.scan-set/1", name=request.name or files.job.id, scans=tuple(
        ScanEntry(name=depth, path=depth, maps=solve) for depth, solve in zip(request.depths, maps, strict=True)))
    with _in_folder(scans, files, files.job.id) as folder:
        wanted = files.request(RegisterRequest, request, scan_set=folder, out=files.out)
        if not sharing.leads:
            help_register(wanted, files.progress, sharing)
            return
        done = register_scans(wanted, files.progress, sharing)
    _, found = read_scan_set(done.scan_set_path)
    named = {entry.name: entry for entry in scans.scans}
    write_scan_set(found.model_copy(update={"scans": tuple(
        entry.model_copy(update={"path": entry.name, "maps": named[entry.name].maps}) for entry in found.scans)}), done.scan_set_path)


def _fuse(request: FuseJob, files: StepFiles, sharing: "SharedPieces") -> None:
    from service.requests.register import FuseRequest
    from service.scans.fusion.fuse import fuse, help_fuse

    _, scans = read_scan_set(files.maps(request.registered) / SCAN_SET_FILE)
    with _in_folder(scans, files, request.registered) as folder:
        wanted = files.request(FuseRequest, request, scan_set=folder, out=files.out)
        if sharing.leads:
            fuse(wanted, files.progress, sharing)
        else:
            help_fuse(wanted, files.progress, sharing)


@contextmanager
def _in_folder(scans: ScanSet, files: StepFiles, name: str) -> Iterator[Path]:
    """Make a folder with a scan-set.json and, beside it, links to the results of the jobs that its paths name."""
    with tempfile.TemporaryDirectory(prefix="relit-scans-") as made:
        folder = Path(made)
        name_place(folder, name)
        for job in {path for entry in scans.scans for path in (entry.path, entry.maps) if path is not None}:
            (folder / job).symlink_to(files.maps(job), target_is_directory=True)
        write_scan_set(scans, folder / SCAN_SET_FILE)
        yield folder
