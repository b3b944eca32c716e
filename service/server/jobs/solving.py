"""Steps of the jobs that solve a capture or measure its depth, or those of each time step of a sequence.

A job of a sequence has a step for each time step alone, and one that joins them. Each is done as a whole or again, and its files are sent
to the storage when it ends; so a worker that takes over goes on with the time step that was under way.
"""

from typing import TYPE_CHECKING

from service.reporting.progress import Progress
from service.requests.jobs import DepthJob, SolveJob
from service.server.database import intakes
from service.server.jobs.context import SEQUENCE, Job, JobStep, WorkerContext
from service.server.jobs.named_files import file_within
from service.server.jobs.pieces import JobPieces
from service.server.jobs.places import intake_folder, results_folder
from service.server.storage import layout

if TYPE_CHECKING:
    from service.requests.depth import DepthRequest
    from service.requests.solve import SolveRequest

TIME_STEP = "step"
"""What the names of the steps begin with that do a time step."""


def steps(job: Job, request: SolveJob | DepthJob, context: WorkerContext) -> list[JobStep]:
    """Return the steps of a solve or a depth.

    Args:
        job: the job, or a part of it is the solve.
        request: names the capture.
        context: of the worker.
    """
    count = intakes.time_steps(intakes.find(context.database, request.capture, job.project))
    if count == 0:
        return [_step(job, request, context, "solve" if isinstance(request, SolveJob) else "depth", None)]
    return [*(_step(job, request, context, f"{TIME_STEP} {number}", number) for number in range(1, count + 1)),
            JobStep(SEQUENCE, lambda progress: _join(job, request, context, progress))]


def _step(job: Job, request: SolveJob | DepthJob, context: WorkerContext, name: str, number: int | None) -> JobStep:
    """Return the step that does a capture, or the time step `number` of a sequence."""
    if isinstance(request, SolveJob):
        return JobStep(name, lambda progress: _solve(job, request, number, context, progress),
                       help=lambda progress: _help_solve(job, request, number, context, progress))
    return JobStep(name, lambda progress: _depth(job, request, number, context, progress))


def _solve(job: Job, request: SolveJob, number: int | None, context: WorkerContext, progress: Progress) -> None:
    from service.sequences.one_step import solve_number
    from service.solve.sharing import SharedSolve
    from service.solve.solve import solve

    pieces = JobPieces(context, job)
    sharing = SharedSolve(pieces, leads=True, invite=pieces.invite)
    wanted = _solve_request(job, request, number, context, progress)
    if number is None:
        solve(wanted, progress, sharing=sharing)
    else:
        _fetch(job, wanted, context, progress)
        solve_number(wanted, number, progress, sharing)
    pieces.remove()


def _help_solve(job: Job, request: SolveJob, number: int | None, context: WorkerContext, progress: Progress) -> None:
    from service.sequences.one_step import help_solve_number
    from service.solve.sharing import SharedSolve
    from service.solve.solve import help_solve

    sharing = SharedSolve(JobPieces(context, job), leads=False)
    wanted = _solve_request(job, request, number, context, progress)
    if number is None:
        help_solve(wanted, progress, sharing)
    else:
        _fetch(job, wanted, context, progress)
        help_solve_number(wanted, number, progress, sharing)


def _depth(job: Job, request: DepthJob, number: int | None, context: WorkerContext, progress: Progress) -> None:
    from service.depth.depth import depth
    from service.sequences.one_step import depth_number

    wanted = _depth_request(job, request, number, context, progress)
    if number is None:
        depth(wanted, progress)
    else:
        depth_number(wanted, number, progress)


def _join(job: Job, request: SolveJob | DepthJob, context: WorkerContext, progress: Progress) -> None:
    """Join the time steps of a sequence, each of which is done, and report on all."""
    from service.sequences.run import depth_sequence, solve_sequence

    if isinstance(request, SolveJob):
        solving = _solve_request(job, request, None, context, progress)
        _fetch(job, solving, context, progress, layout.SOLVED)
        solve_sequence(solving, progress)
    else:
        measuring = _depth_request(job, request, None, context, progress)
        _fetch(job, measuring, context, progress, layout.SOLVED)
        depth_sequence(measuring, progress)


def _fetch(job: Job, request: "SolveRequest | DepthRequest", context: WorkerContext, progress: Progress,
           files: tuple[str, ...] = ()) -> None:
    """Put onto this machine what the time steps that are done have left for others, and some of their files."""
    from service.sequences.one_step import result_folder
    from service.sequences.steps import DONE_FILE
    from stage.sequence import read_sequence

    folders = [result_folder(request, step).relative_to(request.out) for step in read_sequence(request.capture).steps]
    context.storage.local(layout.results(job.project, job.id), [f"{folder}/{name}" for folder in folders for name in (*files, DONE_FILE)],
                          progress)


def _solve_request(job: Job, request: SolveJob, number: int | None, context: WorkerContext, progress: Progress) -> "SolveRequest":
    from service.requests.solve import SolveRequest

    ball = None if request.reference_ball is None else intake_folder(job, request.reference_ball, context, progress)
    return SolveRequest(capture=intake_folder(job, request.capture, context, progress, number), out=results_folder(job, context),
                        reference_ball=ball, device=context.device, cache=context.cache / request.capture, **dict(request.options),
                        **dict(request.sequence))


def _depth_request(job: Job, request: DepthJob, number: int | None, context: WorkerContext, progress: Progress) -> "DepthRequest":
    from service.requests.depth import DepthRequest, TofOptions

    capture = intake_folder(job, request.capture, context, progress, number)
    calibration = None if request.tof_calibration is None else file_within(capture, request.tof_calibration, "tof_calibration")
    options = dict(request.options) | {"tof": TofOptions(calibration=calibration, **dict(request.options.tof))}
    beside = None if request.beside is None else intake_folder(job, request.beside, context, progress)
    return DepthRequest(capture=capture, beside=beside, out=results_folder(job, context), device=context.device,
                        cache=context.cache / request.capture, **options, **dict(request.sequence))
