"""Steps of the jobs that solve a capture or measure its depth, or those of each time step of a sequence.

A job of a sequence has a step for each time step alone, and one that joins them. Each is done as a whole or again, and its files are sent
to the storage when it ends; so a worker that takes over goes on with the time step that was under way.
"""

from typing import TYPE_CHECKING

from service.requests.jobs import DepthJob, SolveJob
from service.server.database import intakes
from service.server.jobs.context import SEQUENCE, Job, JobStep, WorkerContext
from service.server.jobs.pieces import JobPieces
from service.server.jobs.places import StepFiles, file_within
from service.server.storage import layout

if TYPE_CHECKING:
    from service.requests.depth import DepthRequest
    from service.requests.solve import SolveRequest

TIME_STEP = "step"
"""The prefix of the names of steps that solve one time step."""


def steps(job: Job, request: SolveJob | DepthJob, context: WorkerContext) -> list[JobStep]:
    """Return the steps of a solve or a depth."""
    def step(name: str, number: int | None) -> JobStep:
        """Return the step that does the capture, or the time step `number` of a sequence."""
        if isinstance(request, SolveJob):
            return JobStep(name, lambda progress: _solve(request, number, StepFiles(job, context, progress), leads=True),
                           help=lambda progress: _solve(request, number, StepFiles(job, context, progress), leads=False))
        return JobStep(name, lambda progress: _depth(request, number, StepFiles(job, context, progress)))

    count = intakes.time_steps(intakes.find(context.database, request.capture, job.project))
    if count == 0:
        return [step("solve" if isinstance(request, SolveJob) else "depth", None)]
    return [*(step(f"{TIME_STEP} {number}", number) for number in range(1, count + 1)),
            JobStep(SEQUENCE, lambda progress: _join(request, StepFiles(job, context, progress)))]


def _solve(request: SolveJob, number: int | None, files: StepFiles, *, leads: bool) -> None:
    """Solve a capture or a time step or, where another worker leads, do pieces of that."""
    from service.sequences.steps import help_solve_number, solve_number
    from service.sharing.sharing import SharedSolve
    from service.solve.solve import help_solve, solve

    pieces = JobPieces(files.context, files.job)
    sharing = SharedSolve(pieces, leads=True, invite=pieces.invite) if leads else SharedSolve(pieces, leads=False)
    wanted = _solve_request(request, number, files)
    if number is None:
        (solve if leads else help_solve)(wanted, files.progress, sharing=sharing)
    else:
        _fetch(wanted, files)
        (solve_number if leads else help_solve_number)(wanted, number, files.progress, sharing)
    if leads:
        pieces.remove()


def _depth(request: DepthJob, number: int | None, files: StepFiles) -> None:
    from service.depth.depth import depth
    from service.sequences.steps import depth_number

    wanted = _depth_request(request, number, files)
    if number is None:
        depth(wanted, files.progress)
    else:
        depth_number(wanted, number, files.progress)


def _join(request: SolveJob | DepthJob, files: StepFiles) -> None:
    """Join the time steps of a sequence, each of which is done, and report on all."""
    from service.sequences.run import depth_sequence, solve_sequence

    if isinstance(request, SolveJob):
        solving = _solve_request(request, None, files)
        _fetch(solving, files, layout.SOLVED)
        solve_sequence(solving, files.progress)
    else:
        measuring = _depth_request(request, None, files)
        _fetch(measuring, files, layout.SOLVED)
        depth_sequence(measuring, files.progress)


def _fetch(request: "SolveRequest | DepthRequest", files: StepFiles, names: tuple[str, ...] = ()) -> None:
    """Put onto this machine what the time steps that are done have left for others, and some of their files."""
    from service.sequences.steps import DONE_FILE, result_folder
    from stage.capture.sequence import read_sequence

    folders = [result_folder(request, step).relative_to(request.out) for step in read_sequence(request.capture).steps]
    files.context.storage.local(layout.results(files.job.project, files.job.id),
                                [f"{folder}/{name}" for folder in folders for name in (*names, DONE_FILE)], files.progress)


def _solve_request(request: SolveJob, number: int | None, files: StepFiles) -> "SolveRequest":
    from service.requests.solve import SolveRequest

    return files.request(SolveRequest, request, capture=files.intake(request.capture, number), out=files.out, **dict(request.sequence))


def _depth_request(request: DepthJob, number: int | None, files: StepFiles) -> "DepthRequest":
    from service.requests.depth import DepthRequest, TofOptions

    capture = files.intake(request.capture, number)
    calibration = None if request.tof_calibration is None else file_within(capture, request.tof_calibration, "tof_calibration")
    tof = TofOptions(calibration=calibration, **dict(request.options.tof))
    return files.request(DepthRequest, request, capture=capture, out=files.out, tof=tof, **dict(request.sequence))
