"""The steps of a job: each finds the files of the captures, environments and jobs that the request names, and calls a product."""

from collections.abc import Callable
from contextlib import ExitStack

from service.errors import RequestError
from service.reporting.progress import Progress
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
from service.server.jobs import boards, scan_steps, solving
from service.server.jobs.calibrating import CALIBRATIONS
from service.server.jobs.context import Job, JobStep, WorkerContext
from service.server.jobs.measuring import MEASURES, Measurement
from service.server.jobs.places import environment_image, intake_folder, intake_place, job_maps, results_folder, time_step
from service.server.storage import layout

KEYS_FILE = "keys.json"
"""Name of the file with the light keys of a job, which lies beside its frames."""


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
    if isinstance(request, SolveJob | DepthJob):
        return solving.steps(job, request, context)
    if isinstance(request, JoinJob):
        return [JobStep("join", lambda progress: _join(job, request, context, progress))]
    if isinstance(request, RegisterJob | FuseJob):
        return [scan_steps.step_of(job, request, context)]
    if isinstance(request, ShadeJob):
        return [JobStep("shade", lambda progress: _shade(job, request, context, progress))]
    if isinstance(request, ExportJob):
        return [JobStep("export", lambda progress: _export(job, request, context, progress))]
    if isinstance(request, InspectBoardJob):
        return [JobStep("inspect", lambda progress: boards.inspect(
            request, intake_folder(job, request.capture, context, progress), results_folder(job, context),
            lambda other: job_maps(job, other, context, progress), context.device, context.cache / request.capture, progress))]
    if isinstance(request, GaugeBoardJob):
        return [JobStep("gauge", lambda progress: boards.gauge(
            request, job.id, results_folder(job, context), lambda other: job_maps(job, other, context, progress), progress))]
    if isinstance(request, ViewJob):
        return [JobStep("view", lambda progress: _view(job, request, context, progress))]
    measure = (MEASURES | CALIBRATIONS).get(type(request))
    if measure is not None:
        return [JobStep("measure", lambda progress: measure(request, Measurement(
            results_folder(job, context), lambda capture: intake_folder(job, capture, context, progress), context.device, context.cache,
            progress)))]
    if isinstance(request, RelightJob):
        return _frames(job, request, context)
    assert isinstance(request, PipelineJob), request
    solve = SolveJob(kind="solve", capture=request.capture, options=request.solve, sequence=request.sequence)
    export = ExportJob(kind="export", maps=job.id, format=request.format, options=request.export)
    relight = RelightJob(kind="relight", capture=request.capture, environment=request.environment, keys=request.keys,
                         maps=job.id if request.guided else None, options=request.relight)
    return [*solving.steps(job, solve, context),
            JobStep("export", lambda progress: _export(job, export, context, progress)),
            *(_frames(job, relight, context) if request.environment is not None or request.keys is not None else [])]


def _frames(job: Job, request: RelightJob, context: WorkerContext) -> list[JobStep]:
    numbers = frame_numbers(request.options.frames, 1)
    chunks = [numbers[at : at + job.chunk_frames] for at in range(0, len(numbers), job.chunk_frames)]

    def step(chunk: list[int]) -> JobStep:
        only = f"{chunk[0]}-{chunk[-1]}"
        return JobStep(f"frames {only}", lambda progress: _relight(job, request, only, context, progress), len(chunk))

    return [step(chunk) for chunk in chunks]


def _check(job: Job, request: CheckJob, context: WorkerContext, progress: Progress) -> None:
    from service.captures.check_process import check_in_process

    folder, root = intake_place(job, request.intake, context, progress)
    facts = check_in_process(folder, environment=not request.intake.startswith(CAPTURE), root=root, max_pixels=context.max_pixels,
                             progress=progress)
    if root is not None and (what := "scan" if "shots" in facts else "board" if "tiles" in facts else None) is not None:
        raise RequestError(f"a {what} is not registered: upload its folder")
    settings, more = context.settings, quotas.pixels_of(facts)
    intakes.accept(context.database, request.intake, facts, None if settings is None else lambda connection: quotas.require(
        connection, settings, quotas.PIXELS, job.project, more))


def _join(job: Job, request: JoinJob, context: WorkerContext, progress: Progress) -> None:
    from service.joining.join import join
    from service.requests.join import JoinRequest

    join(JoinRequest(maps=job_maps(job, request.maps, context, progress), depth=job_maps(job, request.depth, context, progress),
                     out=results_folder(job, context), device=context.device), progress)


def _shade(job: Job, request: ShadeJob, context: WorkerContext, progress: Progress) -> None:
    from service.light.shade import shade
    from service.requests.shade import ShadeRequest

    capture = request.capture
    shade(ShadeRequest(maps=job_maps(job, request.maps, context, progress), out=results_folder(job, context) / layout.PICTURE,
                       environment=environment_image(job, request.environment, context, progress),
                       capture=None if capture is None else intake_folder(job, capture, context, progress), device=context.device,
                       cache=None if capture is None else context.cache / capture, **dict(request.options)), progress)


def _export(job: Job, request: ExportJob, context: WorkerContext, progress: Progress) -> None:
    from service.export.export import export
    from service.requests.export import ExportRequest

    out = results_folder(job, context) / f"{layout.ASSET}.{request.format}"
    export(ExportRequest(maps=job_maps(job, request.maps, context, progress), out=out,
                         rig=None if request.rig is None else intake_folder(job, request.rig, context, progress),
                         environment=environment_image(job, request.environment, context, progress), **dict(request.options)), progress)


def _view(job: Job, request: ViewJob, context: WorkerContext, progress: Progress) -> None:
    from service.requests.view import ViewRequest
    from service.viewing.view import view

    capture, cache = intake_folder(job, request.capture, context, progress, request.step), context.cache / request.capture
    maps = None if request.maps is None else job_maps(job, request.maps, context, progress)
    if request.step is not None:
        capture = time_step(capture, request.step).folder
        cache, maps = cache / capture.name, None if maps is None else maps / capture.name
    view(ViewRequest(capture=capture, maps=maps, out=results_folder(job, context), device=context.device, cache=cache,
                     **dict(request.options)), progress)


def _relight(job: Job, request: RelightJob, only: str, context: WorkerContext, progress: Progress) -> None:
    from service.light.relight import relight
    from service.requests.relight import RelightRequest
    from stage.files import write_text

    out = results_folder(job, context)
    if request.keys is not None:
        write_text(out / KEYS_FILE, request.keys.model_dump_json(by_alias=True, indent=2, exclude_defaults=True))
    relight(RelightRequest(capture=intake_folder(job, request.capture, context, progress),
                           environment=environment_image(job, request.environment, context, progress),
                           keys=None if request.keys is None else out / KEYS_FILE, only=only, out=str(out / layout.FRAMES),
                           maps=None if request.maps is None else job_maps(job, request.maps, context, progress), device=context.device,
                           cache=context.cache / request.capture, **dict(request.options)), progress)


