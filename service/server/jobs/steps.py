"""The steps of a job: each finds the files of the captures, environments and jobs that the request names, and calls a product."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

from service.errors import RequestError
from service.reporting.progress import Progress
from service.requests import jobs
from service.requests.base.identifiers import CAPTURE
from service.requests.light.frame_range import frame_numbers, numbered
from service.server.database import intakes, quotas
from service.server.jobs import importing, scan_sets, solving
from service.server.jobs.context import Job, JobStep, WorkerContext
from service.server.jobs.one_step import ONE_STEP, export
from service.server.jobs.places import StepFiles
from service.server.storage import layout


def steps_of(job: Job, context: WorkerContext) -> list[JobStep]:
    """Return the steps of a job, which are always the same for the same job."""
    from service.captures.decoders import Decoders
    from stage.formats import images

    held = ExitStack()

    def closing(run: Callable[[Progress], None]) -> Callable[[Progress], None]:
        def step(progress: Progress) -> None:
            with held:
                if not isinstance(job.request, jobs.CheckJob):  # which does not decode, and may run beside another step
                    decoders = Decoders(context.settings.max_pixels)
                    held.callback(decoders.close)
                    held.enter_context(images.decoded_by(decoders))
                run(progress)

        return step

    return [step._replace(run=closing(step.run), help=None if step.help is None else closing(step.help))
            for step in _steps_of(job, context._replace(held=held))]


def _steps_of(job: Job, context: WorkerContext) -> list[JobStep]:
    request = job.request
    if isinstance(request, jobs.CheckJob):
        name, look = (("guess", importing.look) if request.guess else ("check", _check) if request.importing is None else
                      ("import", importing.import_files))
        return [JobStep(name, lambda progress: look(request, StepFiles(job, context, progress)))]
    if isinstance(request, jobs.SolveJob | jobs.DepthJob):
        return solving.steps(job, request, context)
    if isinstance(request, jobs.RegisterJob | jobs.FuseJob):
        return [scan_sets.step_of(job, request, context)]
    if isinstance(request, jobs.RelightJob):
        return _frames(job, request, context)
    if not isinstance(request, jobs.PipelineJob):
        name, do = ONE_STEP[type(request)]
        return [JobStep(name, lambda progress: do(request, StepFiles(job, context, progress)))]
    solve = jobs.SolveJob(kind="solve", capture=request.capture, options=request.solve, sequence=request.sequence)
    asset = jobs.ExportJob(kind="export", maps=job.id, format=request.format, options=request.export)
    relight = jobs.RelightJob(kind="relight", capture=request.capture, environment=request.environment, keys=request.keys,
                              maps=job.id if request.guided else None, options=request.relight)
    return [*solving.steps(job, solve, context),
            JobStep("export", lambda progress: export(asset, StepFiles(job, context, progress))),
            *(_frames(job, relight, context) if request.environment is not None or request.keys is not None else [])]


def _frames(job: Job, request: jobs.RelightJob, context: WorkerContext) -> list[JobStep]:
    numbers = frame_numbers(request.options.frames, 1)
    chunks = [numbers[at : at + job.chunk_frames] for at in range(0, len(numbers), job.chunk_frames)]

    def made(chunk: list[int]) -> int:
        out = context.storage.workspace(layout.results(job.project, job.id))
        return sum(_is_made(out, number) for number in chunk)

    def step(chunk: list[int]) -> JobStep:
        return JobStep(f"frames {chunk[0]}-{chunk[-1]}", lambda progress: _relight(request, chunk, StepFiles(job, context, progress)),
                       len(chunk), lambda: made(chunk))

    return [step(chunk) for chunk in chunks]


def _check(request: jobs.CheckJob, files: StepFiles) -> None:
    from service.captures.check_process import check_in_process

    context, settings = files.context, files.context.settings
    importing.delete_strays(request.intake, files)
    folder, root = files.intake_place(request.intake)
    facts = check_in_process(folder, environment=not request.intake.startswith(CAPTURE), root=root, max_pixels=settings.max_pixels,
                             progress=files.progress)
    if root is not None and (what := "scan" if "shots" in facts else "board" if "tiles" in facts else None) is not None:
        raise RequestError(f"a {what} is not registered: upload its folder")
    intakes.accept(context.database, request.intake, facts, lambda connection: quotas.require(
        connection, settings, quotas.PIXELS, files.job.project, quotas.pixels_of(facts)))


def _relight(request: jobs.RelightJob, chunk: list[int], files: StepFiles) -> None:
    from service.relight.relight import relight
    from service.requests.relight import RelightRequest

    out = files.out
    wanted = files.request(RelightRequest, request, out=str(out / layout.FRAMES))
    for part in _parts(chunk, out) if files.job.is_resumed else [chunk]:
        relight(wanted.model_copy(update={"only": f"{part[0]}-{part[-1]}"}), files.progress)


def _parts(chunk: list[int], out: Path) -> Iterator[list[int]]:
    """Yield the frames that are there with the next one, then the two after it, four, eight and so on.

    The frames of one call appear together at its end. So a worker that does not live long either makes some nevertheless.
    """
    begin, end = 0, 1 + next((at for at, number in enumerate(chunk) if not _is_made(out, number)), len(chunk))
    size = 1
    while begin < len(chunk):
        yield chunk[begin:end]
        size *= 2
        begin, end = end, end + size


def _is_made(out: Path, number: int) -> bool:
    return (out / numbered(layout.FRAMES, number)).is_file()
