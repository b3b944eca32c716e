"""The steps of a job: each finds the files of the captures, environments and jobs that the request names, and calls a product.

A solve or a depth of a sequence has a step for each time step alone, and one that joins them. Each is done as a whole or again, and its
files are sent to the storage when it ends; so a worker that takes over goes on with the time step that was under way.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from service.captures.check_process import check_in_process
from service.errors import RequestError
from service.reporting.progress import Progress
from service.requests import jobs
from service.requests.base.identifiers import CAPTURE
from service.requests.depth import DepthRequest, TofOptions
from service.requests.light.frame_range import frame_numbers, numbered
from service.requests.register import FuseRequest, RegisterRequest
from service.requests.relight import RelightRequest
from service.requests.solve import SolveRequest
from service.server.base.log import logger
from service.server.database import intakes, quotas
from service.server.database.jobs import SEQUENCE
from service.server.database.jobs import find as find_job
from service.server.jobs import importing
from service.server.jobs.context import Job, JobStep, StepFiles, WorkerContext, file_within
from service.server.jobs.one_step import ONE_STEP, export
from service.server.jobs.pieces import JobPieces
from service.server.storage import layout
from stage.capture.sequence import read_sequence
from stage.sets.scan_set import SCAN_SET_FILE, ScanEntry, ScanSet, read_scan_set, write_scan_set

if TYPE_CHECKING:
    from service.scans.pieces import SharedPieces

TIME_STEP = "step"
"""The prefix of the names of steps that solve one time step."""


def steps_of(job: Job, context: WorkerContext) -> list[JobStep]:
    """Return the steps of a job, which are always the same for the same job."""
    request = job.request
    if isinstance(request, jobs.CheckJob):
        name, look = (("guess", importing.look) if request.guess else ("check", _check) if request.importing is None else
                      ("import", importing.import_files))
        return [JobStep(name, partial(look, request))]
    if isinstance(request, jobs.SolveJob | jobs.DepthJob):
        return _time_steps(job, request, context)
    if isinstance(request, jobs.RegisterJob):
        return [_shared(request.kind, partial(_register, request))]
    if isinstance(request, jobs.FuseJob):
        return [_shared(request.kind, partial(_fuse, request))]
    if isinstance(request, jobs.RelightJob):
        return _frames(job, request, context)
    if not isinstance(request, jobs.PipelineJob):
        name, do = ONE_STEP[type(request)]
        return [JobStep(name, partial(do, request))]
    solve = jobs.SolveJob(kind="solve", capture=request.capture, options=request.solve, sequence=request.sequence)
    asset = jobs.ExportJob(kind="export", maps=job.id, format=request.format, options=request.export)
    relight = jobs.RelightJob(kind="relight", capture=request.capture, environment=request.environment, keys=request.keys,
                              maps=job.id if request.guided else None, options=request.relight)
    return [*_time_steps(job, solve, context), JobStep("export", partial(export, asset)),
            *(_frames(job, relight, context) if request.environment is not None or request.keys is not None else [])]


def help_with(job: Job, context: WorkerContext, progress: Progress) -> None:
    """Do what can be done beside the worker that has a job, until nothing is left to take: pieces of its solve, or chunks of its frames."""
    def finished() -> list[str]:
        row = find_job(context.database, job.id)
        return [] if row is None else row["finished_steps"]

    progress.advance(0)
    steps, pieces, done = steps_of(job, context), JobPieces(context, job), finished()
    divided = next((step for step in steps if step.name not in done and not step.frames), None)
    if divided is not None:
        if divided.help is not None:
            with StepFiles.of(job, context, progress) as files:
                divided.help(files)
        return  # for the steps after it help is asked for again
    pieces.require_same_kind()
    for step in steps:
        if step.frames and step.name not in finished() and not pieces.is_finished(step.name) and pieces.claim_step(step.name):
            logger.info("help with step", job=job.id, step=step.name, worker=context.worker)
            with StepFiles.of(job, context, progress) as files:
                step.run(files)
            context.storage.publish(layout.results(job.project, job.id), progress, alone=False)
            pieces.finish_step(step.name)


def _shared(name: str, do: Callable[..., None]) -> JobStep:
    """Return a step of which several workers do pieces; `do` is called with its pieces and, by its name, whether this worker leads."""
    def run(files: StepFiles, *, leads: bool) -> None:
        pieces = JobPieces(files.context, files.job)
        do(files, pieces, leads=leads)
        if leads:
            pieces.remove()

    return JobStep(name, partial(run, leads=True), help=partial(run, leads=False))


def _time_steps(job: Job, request: jobs.SolveJob | jobs.DepthJob, context: WorkerContext) -> list[JobStep]:
    """Return the steps of a solve or a depth."""
    def step(name: str, number: int | None) -> JobStep:
        """Return the step that does the capture, or the time step `number` of a sequence."""
        if isinstance(request, jobs.SolveJob):
            return _shared(name, partial(_solve, request, number))
        return JobStep(name, partial(_depth, request, number))

    count = intakes.time_steps(intakes.find(context.database, request.capture, job.project))
    if count == 0:
        return [step("solve" if isinstance(request, jobs.SolveJob) else "depth", None)]
    return [*(step(f"{TIME_STEP} {number}", number) for number in range(1, count + 1)),
            JobStep(SEQUENCE, partial(_join, request))]


def _solve(request: jobs.SolveJob, number: int | None, files: StepFiles, pieces: JobPieces, *, leads: bool) -> None:
    """Solve a capture or a time step or, where another worker leads, do pieces of that."""
    from service.sequences.steps import help_solve_number, solve_number
    from service.sharing.sharing import SharedSolve
    from service.solve.solve import help_solve, solve

    sharing = SharedSolve(pieces, leads=True, invite=pieces.invite) if leads else SharedSolve(pieces, leads=False)
    wanted = _solve_request(request, number, files)
    if number is None:
        files.tell((solve if leads else help_solve)(wanted, files.progress, sharing=sharing))
    else:
        _fetch(wanted, files)
        (solve_number if leads else help_solve_number)(wanted, number, files.progress, sharing)


def _depth(request: jobs.DepthJob, number: int | None, files: StepFiles) -> None:
    from service.depth.depth import depth
    from service.sequences.steps import depth_number

    wanted = _depth_request(request, number, files)
    if number is None:
        files.tell(depth(wanted, files.progress))
    else:
        depth_number(wanted, number, files.progress)


def _join(request: jobs.SolveJob | jobs.DepthJob, files: StepFiles) -> None:
    """Join the time steps of a sequence, each of which is done, and report on all."""
    from service.sequences.run import depth_sequence, solve_sequence

    wanted = _solve_request(request, None, files) if isinstance(request, jobs.SolveJob) else _depth_request(request, None, files)
    _fetch(wanted, files, layout.SOLVED)
    files.tell(solve_sequence(wanted, files.progress) if isinstance(wanted, SolveRequest) else depth_sequence(wanted, files.progress))


def _fetch(request: SolveRequest | DepthRequest, files: StepFiles, names: tuple[str, ...] = ()) -> None:
    """Put onto this machine what the time steps that are done have left for others, and some of their files."""
    from service.sequences.steps import DONE_FILE, result_folder

    folders = [result_folder(request, step).relative_to(request.out) for step in read_sequence(request.capture).steps]
    files.context.storage.local(layout.results(files.job.project, files.job.id),
                                [f"{folder}/{name}" for folder in folders for name in (*names, DONE_FILE)], files.progress)


def _solve_request(request: jobs.SolveJob, number: int | None, files: StepFiles) -> SolveRequest:
    return files.request(SolveRequest, request, capture=files.intake(request.capture, number), out=files.out, **dict(request.sequence))


def _depth_request(request: jobs.DepthJob, number: int | None, files: StepFiles) -> DepthRequest:
    capture = files.intake(request.capture, number)
    calibration = None if request.tof_calibration is None else file_within(capture, request.tof_calibration, "tof_calibration")
    tof = TofOptions(calibration=calibration, **dict(request.options.tof))
    return files.request(DepthRequest, request, capture=capture, out=files.out, tof=tof, **dict(request.sequence))


def _frames(job: Job, request: jobs.RelightJob, context: WorkerContext) -> list[JobStep]:
    numbers = frame_numbers(request.options.frames, 1)
    chunks = [numbers[at : at + job.chunk_frames] for at in range(0, len(numbers), job.chunk_frames)]

    def step(chunk: list[int]) -> JobStep:
        out = layout.results(job.project, job.id)
        return JobStep(f"frames {chunk[0]}-{chunk[-1]}", partial(_relight, request, chunk), len(chunk),
                       lambda: sum(_is_made(context.storage.workspace(out), number) for number in chunk))

    return [step(chunk) for chunk in chunks]


def _relight(request: jobs.RelightJob, chunk: list[int], files: StepFiles) -> None:
    from service.relight.relight import relight

    out = files.out
    wanted = files.request(RelightRequest, request, out=str(out / layout.FRAMES))
    for part in _parts(chunk, out) if files.job.is_resumed else [chunk]:
        files.tell(relight(wanted.model_copy(update={"only": f"{part[0]}-{part[-1]}"}), files.progress))


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


def _check(request: jobs.CheckJob, files: StepFiles) -> None:
    settings = files.context.settings
    importing.delete_strays(request.intake, files)
    folder, root = files.intake_place(request.intake)
    facts = check_in_process(folder, environment=not request.intake.startswith(CAPTURE), root=root, max_pixels=settings.max_pixels,
                             progress=files.progress)
    if root is not None and (what := "scan" if "shots" in facts else "board" if "tiles" in facts else None) is not None:
        raise RequestError(f"a {what} is not registered: upload its folder")
    intakes.accept(files.context.database, request.intake, facts, lambda connection: quotas.require(
        connection, settings, quotas.PIXELS, files.job.project, quotas.pixels_of(facts)))


def _register(request: jobs.RegisterJob, files: StepFiles, pieces: JobPieces, *, leads: bool) -> None:
    """Find the poses of the depths of other jobs; the scan-set.json among the results names the jobs, not their folders."""
    from service.scans.register import help_register, register_scans

    maps: tuple[str | None, ...] = request.solves or (None,) * len(request.depths)
    scans = ScanSet(schema="relit.scan-set/1", name=request.name or files.job.id, scans=tuple(
        ScanEntry(name=depth, path=depth, maps=solve) for depth, solve in zip(request.depths, maps, strict=True)))
    with _linked(scans, files, files.job.id) as folder:
        wanted = files.request(RegisterRequest, request, scan_set=folder, out=files.out)
        if not leads:
            help_register(wanted, files.progress, _sharing(pieces, leads=False))
            return
        done = register_scans(wanted, files.progress, _sharing(pieces, leads=True))
    files.tell(done)
    _, found = read_scan_set(done.scan_set_path)
    named = {entry.name: entry for entry in scans.scans}
    write_scan_set(found.model_copy(update={"scans": tuple(
        entry.model_copy(update={"path": entry.name, "maps": named[entry.name].maps}) for entry in found.scans)}), done.scan_set_path)


def _fuse(request: jobs.FuseJob, files: StepFiles, pieces: JobPieces, *, leads: bool) -> None:
    from service.scans.fusion.fuse import fuse, help_fuse

    _, scans = read_scan_set(files.maps(request.registered) / SCAN_SET_FILE)
    with _linked(scans, files, request.registered) as folder:
        wanted = files.request(FuseRequest, request, scan_set=folder, out=files.out)
        files.tell((fuse if leads else help_fuse)(wanted, files.progress, _sharing(pieces, leads=leads)))


def _sharing(pieces: JobPieces, *, leads: bool) -> "SharedPieces":
    from service.scans.pieces import SharedPieces

    return SharedPieces(pieces, leads=True, invite=pieces.invite) if leads else SharedPieces(pieces, leads=False)


@contextmanager
def _linked(scans: ScanSet, files: StepFiles, name: str) -> Iterator[Path]:
    """Make a folder with a scan-set.json and, beside it, links to the results of the jobs that its paths name."""
    with files.linked((path for entry in scans.scans for path in (entry.path, entry.maps) if path is not None), name) as folder:
        write_scan_set(scans, folder / SCAN_SET_FILE)
        yield folder
