"""The steps of a job: each finds the files of the captures, environments and jobs that the request names, and calls a product."""

from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from service.errors import RequestError
from service.reporting.progress import Progress
from service.reporting.provenance import name_place
from service.requests.frame_range import frame_numbers
from service.requests.identifiers import CAPTURE
from service.requests.jobs import (
    CheckJob,
    DepthJob,
    ExportJob,
    FuseJob,
    GaugeBoardJob,
    InspectBoardJob,
    JoinJob,
    PipelineJob,
    RegisterJob,
    RelightJob,
    ShadeJob,
    SolveJob,
    ViewJob,
)
from service.server.database import intakes, quotas
from service.server.jobs import boards, calibrating, measuring, scan_sets
from service.server.jobs.context import Job, WorkerContext
from service.server.jobs.named_files import file_within
from service.server.jobs.pieces import JobPieces
from service.server.storage import layout
from stage import inputs
from stage.files import resolved

if TYPE_CHECKING:
    from service.requests.solve import SolveRequest

KEYS_FILE = "keys.json"
"""Name of the file with the light keys of a job, which lies beside its frames."""


class JobStep(NamedTuple):
    """A part of a job that is done as a whole or again."""

    name: str
    run: Callable[[Progress], None]
    frames: int = 0
    """Number of frames that the step makes, at the same time as other workers make those of other steps."""
    help: Callable[[Progress], None] | None = None
    """Does pieces of the step beside the worker that runs it; None: it cannot be divided."""


def steps_of(job: Job, context: WorkerContext) -> list[JobStep]:
    """Return the steps of a job, which are always the same for the same job."""
    from service.captures.decoders import Decoders
    from stage import images

    held = ExitStack()

    def closing(run: Callable[[Progress], None]) -> Callable[[Progress], None]:
        def step(progress: Progress) -> None:
            with held:
                if not isinstance(job.request, CheckJob):  # which does not decode, and may run beside another step
                    decoders = Decoders(context.max_pixels)
                    held.callback(decoders.close)
                    held.enter_context(images.decoded_by(decoders))
                run(progress)

        return step

    return [step._replace(run=closing(step.run), help=None if step.help is None else closing(step.help))
            for step in _steps_of(job, context._replace(held=held))]


def _steps_of(job: Job, context: WorkerContext) -> list[JobStep]:
    request = job.request
    if isinstance(request, CheckJob):
        return [JobStep("check", lambda progress: _check(job, request, context, progress))]
    if isinstance(request, SolveJob):
        return [_solve_step(job, request, context)]
    if isinstance(request, DepthJob):
        return [JobStep("depth", lambda progress: _depth(job, request, context, progress))]
    if isinstance(request, JoinJob):
        return [JobStep("join", lambda progress: _join(job, request, context, progress))]
    if isinstance(request, RegisterJob):
        return [_register_step(job, request, context)]
    if isinstance(request, FuseJob):
        return [JobStep("fuse", lambda progress: scan_sets.fuse(
            request, job.id, _out(job, context), lambda other: job_maps(job, other, context, progress), context.device, progress))]
    if isinstance(request, ShadeJob):
        return [JobStep("shade", lambda progress: _shade(job, request, context, progress))]
    if isinstance(request, ExportJob):
        return [JobStep("export", lambda progress: _export(job, request, context, progress))]
    if isinstance(request, InspectBoardJob):
        return [JobStep("inspect", lambda progress: boards.inspect(
            request, _intake(job, request.capture, context, progress), _out(job, context),
            lambda other: job_maps(job, other, context, progress), context.device, context.cache / request.capture, progress))]
    if isinstance(request, GaugeBoardJob):
        return [JobStep("gauge", lambda progress: boards.gauge(
            request, job.id, _out(job, context), lambda other: job_maps(job, other, context, progress), progress))]
    if isinstance(request, ViewJob):
        return [JobStep("view", lambda progress: _view(job, request, context, progress))]
    run = measuring.run if measuring.can_run(request) else calibrating.run if calibrating.can_run(request) else None
    if run is not None:
        return [JobStep("measure", lambda progress: run(
            request, _out(job, context), lambda capture: _intake(job, capture, context, progress), device=context.device,
            cache=context.cache, progress=progress))]
    if isinstance(request, RelightJob):
        return _frames(job, request, context)
    assert isinstance(request, PipelineJob), request
    solve = SolveJob(kind="solve", capture=request.capture, options=request.solve)
    export = ExportJob(kind="export", maps=job.id, format=request.format, options=request.export)
    relight = RelightJob(kind="relight", capture=request.capture, environment=request.environment, keys=request.keys,
                         maps=job.id if request.guided else None, options=request.relight)
    return [_solve_step(job, solve, context),
            JobStep("export", lambda progress: _export(job, export, context, progress)),
            *(_frames(job, relight, context) if request.environment is not None or request.keys is not None else [])]


def job_maps(job: Job, maps: str, context: WorkerContext, progress: Progress) -> Path:
    """Return the folder with the maps of `maps`, a job of the same project or this job."""
    return _named(context.storage.local(layout.results(job.project, maps), layout.SOLVED, progress), maps)


def _solve_step(job: Job, request: SolveJob, context: WorkerContext) -> JobStep:
    return JobStep("solve", lambda progress: _solve(job, request, context, progress),
                   help=lambda progress: _help_solve(job, request, context, progress))


def _register_step(job: Job, request: RegisterJob, context: WorkerContext) -> JobStep:
    def places(progress: Progress) -> Callable[[str], Path]:
        return lambda other: job_maps(job, other, context, progress)

    def run(progress: Progress) -> None:
        from service.scans.pieces import SharedPieces

        pieces = JobPieces(context, job)
        scan_sets.register(request, job.id, _out(job, context), places(progress), progress, SharedPieces(pieces, invite=pieces.invite))
        pieces.remove()

    def help_others(progress: Progress) -> None:
        from service.scans.pieces import SharedPieces

        scan_sets.help_register(request, job.id, _out(job, context), places(progress), progress,
                                SharedPieces(JobPieces(context, job), leads=False))

    return JobStep("register", run, help=help_others)


def _frames(job: Job, request: RelightJob, context: WorkerContext) -> list[JobStep]:
    numbers = frame_numbers(request.options.frames, 1)
    chunks = [numbers[at : at + job.chunk_frames] for at in range(0, len(numbers), job.chunk_frames)]

    def step(chunk: list[int]) -> JobStep:
        only = f"{chunk[0]}-{chunk[-1]}"
        return JobStep(f"frames {only}", lambda progress: _relight(job, request, only, context, progress), len(chunk))

    return [step(chunk) for chunk in chunks]


def _check(job: Job, request: CheckJob, context: WorkerContext, progress: Progress) -> None:
    from service.captures.check_process import check_in_process

    folder, root = _place(job, request.intake, context, progress)
    facts = check_in_process(folder, environment=not request.intake.startswith(CAPTURE), root=root, max_pixels=context.max_pixels,
                             progress=progress)
    if root is not None and (what := "scan" if "shots" in facts else "board" if "tiles" in facts else None) is not None:
        raise RequestError(f"a {what} is not registered: upload its folder")
    settings, more = context.settings, quotas.pixels_of(facts)
    intakes.accept(context.database, request.intake, facts, None if settings is None else lambda connection: quotas.require(
        connection, settings, quotas.PIXELS, job.project, more))


def _solve(job: Job, request: SolveJob, context: WorkerContext, progress: Progress) -> None:
    from service.solve.sharing import SharedSolve
    from service.solve.solve import solve

    pieces = JobPieces(context, job)
    solve(_solve_request(job, request, context, progress), progress, sharing=SharedSolve(pieces, leads=True, invite=pieces.invite))
    pieces.remove()


def _help_solve(job: Job, request: SolveJob, context: WorkerContext, progress: Progress) -> None:
    from service.solve.sharing import SharedSolve
    from service.solve.solve import help_solve

    help_solve(_solve_request(job, request, context, progress), progress, SharedSolve(JobPieces(context, job), leads=False))


def _solve_request(job: Job, request: SolveJob, context: WorkerContext, progress: Progress) -> "SolveRequest":
    from service.requests.solve import SolveRequest

    ball = None if request.reference_ball is None else _intake(job, request.reference_ball, context, progress)
    return SolveRequest(capture=_intake(job, request.capture, context, progress), out=_out(job, context), reference_ball=ball,
                        device=context.device, cache=context.cache / request.capture, **dict(request.options))


def _depth(job: Job, request: DepthJob, context: WorkerContext, progress: Progress) -> None:
    from service.depth.depth import depth
    from service.requests.depth import DepthRequest, TofOptions

    capture = _intake(job, request.capture, context, progress)
    calibration = None if request.tof_calibration is None else file_within(capture, request.tof_calibration, "tof_calibration")
    options = dict(request.options) | {"tof": TofOptions(calibration=calibration, **dict(request.options.tof))}
    beside = None if request.beside is None else _intake(job, request.beside, context, progress)
    depth(DepthRequest(capture=capture, beside=beside, out=_out(job, context), device=context.device,
                       cache=context.cache / request.capture, **options), progress)


def _join(job: Job, request: JoinJob, context: WorkerContext, progress: Progress) -> None:
    from service.joining.join import join
    from service.requests.join import JoinRequest

    join(JoinRequest(maps=job_maps(job, request.maps, context, progress), depth=job_maps(job, request.depth, context, progress),
                     out=_out(job, context), device=context.device), progress)


def _shade(job: Job, request: ShadeJob, context: WorkerContext, progress: Progress) -> None:
    from service.light.shade import shade
    from service.requests.shade import ShadeRequest

    capture = request.capture
    shade(ShadeRequest(maps=job_maps(job, request.maps, context, progress), out=_out(job, context) / layout.PICTURE,
                       environment=_environment(job, request.environment, context, progress),
                       capture=None if capture is None else _intake(job, capture, context, progress), device=context.device,
                       cache=None if capture is None else context.cache / capture, **dict(request.options)), progress)


def _export(job: Job, request: ExportJob, context: WorkerContext, progress: Progress) -> None:
    from service.export.export import export
    from service.requests.export import ExportRequest

    export(ExportRequest(maps=job_maps(job, request.maps, context, progress), out=_out(job, context) / f"{layout.ASSET}.{request.format}",
                         rig=None if request.rig is None else _intake(job, request.rig, context, progress),
                         environment=_environment(job, request.environment, context, progress), **dict(request.options)), progress)


def _view(job: Job, request: ViewJob, context: WorkerContext, progress: Progress) -> None:
    from service.requests.view import ViewRequest
    from service.viewing.view import view

    view(ViewRequest(capture=_intake(job, request.capture, context, progress),
                     maps=None if request.maps is None else job_maps(job, request.maps, context, progress), out=_out(job, context),
                     device=context.device, cache=context.cache / request.capture, **dict(request.options)), progress)


def _relight(job: Job, request: RelightJob, only: str, context: WorkerContext, progress: Progress) -> None:
    from service.light.relight import relight
    from service.requests.relight import RelightRequest
    from stage.files import write_text

    out = _out(job, context)
    if request.keys is not None:
        write_text(out / KEYS_FILE, request.keys.model_dump_json(by_alias=True, indent=2, exclude_defaults=True))
    relight(RelightRequest(capture=_intake(job, request.capture, context, progress),
                           environment=_environment(job, request.environment, context, progress),
                           keys=None if request.keys is None else out / KEYS_FILE, only=only, out=str(out / layout.FRAMES),
                           maps=None if request.maps is None else job_maps(job, request.maps, context, progress), device=context.device,
                           cache=context.cache / request.capture, **dict(request.options)), progress)


def _out(job: Job, context: WorkerContext) -> Path:
    return _named(context.storage.workspace(layout.results(job.project, job.id)), job.id)


def _named(place: Path, identifier: str) -> Path:
    """Return a place of the server, which reports then name by its identifier."""
    name_place(place, identifier)
    return place


def _intake(job: Job, identifier: str, context: WorkerContext, progress: Progress) -> Path:
    """Return the folder of a capture or environment of the job's project; a registered one is checked again, as it may have changed."""
    from service.captures.admit import admit_environment, recheck_capture

    folder, root = _place(job, identifier, context, progress)
    if root is not None and identifier.startswith(CAPTURE):
        recheck_capture(folder, max_pixels=context.max_pixels)
    elif root is not None:
        admit_environment(folder, max_pixels=context.max_pixels)
    return folder


def _place(job: Job, identifier: str, context: WorkerContext, progress: Progress) -> tuple[Path, Path | None]:
    """Return the folder (or the file of an environment) of an intake of the job's project, and the root of a registered one.

    The files of a registered one are opened beneath its folder until the step ends, whatever becomes links meanwhile.
    """
    row = intakes.find(context.database, identifier, job.project)
    if row is None:
        raise RequestError(f"{identifier}: is not there any more")
    if row["folder"] is None:
        return _named(context.storage.local(layout.intake(job.project, identifier), progress=progress), identifier), None
    folder = Path(row["folder"])
    root = next((root for root in context.roots_of(job.project) if folder.is_relative_to(root)), None)
    if resolved(folder) != folder or root is None:
        raise RequestError(f"{identifier}: lies in none of the folders that the operator allows any more")
    top = folder if identifier.startswith(CAPTURE) else folder.parent
    context.held.enter_context(inputs.confined(top, root, max_pixels=context.max_pixels))
    return _named(folder, identifier), root


def _environment(job: Job, identifier: str | None, context: WorkerContext, progress: Progress) -> Path | None:
    from service.captures.admit import environment_file

    return None if identifier is None else environment_file(_intake(job, identifier, context, progress))

