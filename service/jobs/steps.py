"""A job → the steps that do it: names in place of paths made paths again, and the pipelines called."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from service.errors import RequestError
from service.frame_range import frame_numbers
from service.identifiers import CAPTURE
from service.job_requests import (
    ANY_JOB,
    CheckJob,
    DepthJob,
    ExportJob,
    JobRequest,
    PipelineJob,
    RelightJob,
    ShadeJob,
    SolveJob,
)
from service.progress import Progress
from service.storage import layout
from service.storage.folder import Storage
from service.store import intakes
from service.store.database import Database

KEYS_FILE = "keys.json"
"""The light keys of a job, beside its frames."""


class Site(NamedTuple):
    """Where a worker works."""

    database: Database
    storage: Storage
    cache: Path
    """Folder for stack caches, one a capture."""
    device: str
    max_pixels: int


class Step(NamedTuple):
    """A piece of a job that is done whole or again."""

    name: str
    run: Callable[[Progress], None]
    before: int = 0
    """Frames of the job before its own."""
    of: int | None = None
    """Frames of the job; None: the step makes none."""


class Job(NamedTuple):
    """What a worker knows of a job."""

    id: str
    project: str
    request: JobRequest
    chunk_frames: int

    @classmethod
    def of(cls, row: "dict[str, object]") -> "Job":
        """From its row in the store."""
        return cls(str(row["id"]), str(row["project"]), ANY_JOB.validate_python(row["request"]), int(str(row["chunk_frames"])))


def steps_of(job: Job, site: Site) -> list[Step]:
    """The steps of a job: always the same for the same job."""
    request = job.request
    if isinstance(request, CheckJob):
        return [Step("check", lambda progress: _check(job, request, site, progress))]
    if isinstance(request, SolveJob):
        return [Step("solve", lambda progress: _solve(job, request, site, progress))]
    if isinstance(request, DepthJob):
        return [Step("depth", lambda progress: _depth(job, request, site, progress))]
    if isinstance(request, ShadeJob):
        return [Step("shade", lambda progress: _shade(job, request, site, progress))]
    if isinstance(request, ExportJob):
        return [Step("export", lambda progress: _export(job, request, job_maps(job, request.maps, site), site, progress))]
    if isinstance(request, RelightJob):
        return _frames(job, request, site)
    assert isinstance(request, PipelineJob), request
    solve = SolveJob(kind="solve", capture=request.capture, options=request.solve)
    export = ExportJob(kind="export", maps=job.id, format=request.format, options=request.export)
    relight = RelightJob(kind="relight", capture=request.capture, environment=request.environment, keys=request.keys,
                         maps=job.id if request.guided else None, options=request.relight)
    return [Step("solve", lambda progress: _solve(job, solve, site, progress)),
            Step("export", lambda progress: _export(job, export, job_maps(job, job.id, site), site, progress)),
            *(_frames(job, relight, site) if request.environment is not None or request.keys is not None else [])]


def job_maps(job: Job, maps: str, site: Site) -> Path:
    """The folder of the results of a job of the same project, or of this one."""
    prefix = layout.results(job.project, maps)
    return site.storage.workspace(prefix) if maps == job.id else site.storage.local(prefix)


def _frames(job: Job, request: RelightJob, site: Site) -> list[Step]:
    numbers = frame_numbers(request.options.frames, 1)
    chunks = [numbers[at : at + job.chunk_frames] for at in range(0, len(numbers), job.chunk_frames)]

    def step(chunk: list[int]) -> Step:
        only = f"{chunk[0]}-{chunk[-1]}"
        return Step(f"frames {only}", lambda progress: _relight(job, request, only, site, progress), chunk[0] - numbers[0], len(numbers))

    return [step(chunk) for chunk in chunks]


def _check(job: Job, request: CheckJob, site: Site, progress: Progress) -> None:
    from service.pipelines.admit import admit_capture, admit_environment

    folder = _intake(job, request.intake, site)
    if request.intake.startswith(CAPTURE):
        facts = admit_capture(folder, max_pixels=site.max_pixels, progress=progress)
    else:
        facts = admit_environment(folder, max_pixels=site.max_pixels)
    intakes.accept(site.database, request.intake, facts)


def _solve(job: Job, request: SolveJob, site: Site, progress: Progress) -> None:
    from service.pipelines.solve import solve
    from service.requests import SolveRequest

    ball = None if request.reference_ball is None else _intake(job, request.reference_ball, site)
    solve(SolveRequest(capture=_intake(job, request.capture, site), out=_out(job, site), reference_ball=ball, device=site.device,
                       cache=site.cache / request.capture, **dict(request.options)), progress)


def _depth(job: Job, request: DepthJob, site: Site, progress: Progress) -> None:
    from service.depth_requests import DepthRequest
    from service.pipelines.depth import depth
    from service.tof_options import TofOptions

    capture = _intake(job, request.capture, site)
    calibration = None if request.tof_calibration is None else _within(capture, request.tof_calibration)
    options = dict(request.options) | {"tof": TofOptions(calibration=calibration, **dict(request.options.tof))}
    depth(DepthRequest(capture=capture, out=_out(job, site), device=site.device, cache=site.cache / request.capture, **options), progress)


def _shade(job: Job, request: ShadeJob, site: Site, progress: Progress) -> None:
    from service.pipelines.shade import shade
    from service.requests import ShadeRequest

    capture = request.capture
    shade(ShadeRequest(maps=job_maps(job, request.maps, site), out=_out(job, site) / layout.PICTURE,
                       environment=_environment(job, request.environment, site),
                       capture=None if capture is None else _intake(job, capture, site), device=site.device,
                       cache=None if capture is None else site.cache / capture, **dict(request.options)), progress)


def _export(job: Job, request: ExportJob, maps: Path, site: Site, progress: Progress) -> None:
    from service.pipelines.export import export
    from service.requests import ExportRequest

    export(ExportRequest(maps=maps, out=_out(job, site) / f"{layout.ASSET}.{request.format}", **dict(request.options)), progress)


def _relight(job: Job, request: RelightJob, only: str, site: Site, progress: Progress) -> None:
    from service.pipelines.relight import relight
    from service.requests import RelightRequest
    from stage.files import write_text

    out = _out(job, site)
    if request.keys is not None:
        write_text(out / KEYS_FILE, request.keys.model_dump_json(by_alias=True, indent=2, exclude_defaults=True))
    relight(RelightRequest(capture=_intake(job, request.capture, site), environment=_environment(job, request.environment, site),
                           keys=None if request.keys is None else out / KEYS_FILE, only=only, out=str(out / layout.FRAMES),
                           maps=None if request.maps is None else job_maps(job, request.maps, site), device=site.device,
                           cache=site.cache / request.capture, **dict(request.options)), progress)


def _out(job: Job, site: Site) -> Path:
    return site.storage.workspace(layout.results(job.project, job.id))


def _intake(job: Job, identifier: str, site: Site) -> Path:
    """The folder of a capture or environment of the job's project."""
    row = intakes.find(site.database, identifier, job.project)
    if row is None:
        raise RequestError(f"{identifier}: is not there any more")
    return Path(row["folder"]) if row["folder"] is not None else site.storage.local(layout.intake(job.project, identifier))


def _environment(job: Job, identifier: str | None, site: Site) -> Path | None:
    from service.pipelines.admit import environment_file

    return None if identifier is None else environment_file(_intake(job, identifier, site))


def _within(capture: Path, name: str) -> Path:
    path = capture / name
    if not path.resolve().is_relative_to(capture.resolve()) or "\0" in name:
        raise RequestError(f"tof_calibration: {name} leads out of the capture's folder")
    return path


def drop_caches(cache: Path, captures: list[str]) -> None:
    """Forget the stacks of captures that are gone."""
    for capture in captures:
        shutil.rmtree(cache / capture, ignore_errors=True)
