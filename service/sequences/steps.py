"""The steps of a sequence done one after another: each from its own capture, whole or not at all, and not again where it is done."""

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from service.depth.depth import depth
from service.errors import RequestError
from service.reporting.progress import Progress
from service.reporting.provenance import REPORT_FILE, reported_versions, requested, with_names
from service.requests.base.base import Request
from service.requests.depth import DepthRequest
from service.requests.solve import Intensities, LightsKnown, SolveRequest
from service.sharing.sharing import SharedSolve
from service.solve.lights.intensities import LightsOverTime
from service.solve.solve import help_solve, solve
from stage.capture.capture import Capture
from stage.capture.manifest import FILE_NAME
from stage.capture.sequence import Sequence, TimeStep, check_alike, read_sequence
from stage.errors import ResultError
from stage.files import write_text
from stage.formats.ply import POINTS_FILE
from stage.results.depth_maps import DEPTH_FILE
from stage.results.maps import MAPS_FILE
from stage.stack.fingerprint import Fingerprints, digest
from stage.stack.ingest import CACHE_FOLDER

ALONE = "alone"
"""The folder, in that of a step, of what was found from the step alone."""
DONE_FILE = "step.json"
"""The file that marks a step as done, and names its inputs; written last."""
DONE_SCHEMA = "relit.step/1"
RESULTS = (MAPS_FILE, DEPTH_FILE, POINTS_FILE, REPORT_FILE)
"""The files that a solve or a depth leaves."""
AnyRequest = TypeVar("AnyRequest", SolveRequest, DepthRequest)


class StepProgress:
    """The progress of one step, whose stages are named after it."""

    def __init__(self, inner: Progress | None, number: int, count: int) -> None:
        """Tell `inner` of the step with this number, from 1, of `count` steps."""
        self._inner, self._place = inner, f"{number}/{count}"

    def stage(self, name: str, total: int) -> None:
        """Begin a stage."""
        if self._inner is not None:
            self._inner.stage(f"{self._place} {name}", total)

    def advance(self, done: int) -> None:
        """Pass the finished steps on."""
        if self._inner is not None:
            self._inner.advance(done)


def check_outputs(out: Path, sequence: Sequence) -> None:
    """Check that no result of a step would lie in a capture."""
    folders = {step.folder.resolve() for step in sequence.steps}
    for step in sequence.steps:
        if (out / step.name).resolve() in folders:
            raise RequestError(f"--out {out}: {step.name} in it is a capture of the sequence: choose another folder")


def capture_digest(folder: Path, request: Request, shared: object) -> str:
    """Return a hash of everything that the result of a step follows from: its capture, its request, and what other steps have given it,
    `shared`, as plain data."""
    capture = Capture.open(folder)
    names = sorted({name for _, name in capture.files()})
    hashes = Fingerprints(capture.folder, (request.cache or capture.folder / CACHE_FOLDER) / "files.json").of(names)
    content = {"files": [hashes[name] for name in names], "names": names, "manifest": digest(capture.folder / FILE_NAME),
               "options": {name: value for name, value in requested(request).items() if name != "capture"}, "versions": reported_versions(),
               "shared": shared}
    text = with_names(json.dumps(content, sort_keys=True, default=str))  # folders of a service differ from machine to machine
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


def done(folder: Path, content: str) -> dict[str, Any] | None:
    """Return what a step that is done has left for others, or None where it is not done, or not from this content of capture_digest."""
    found = _done_file(folder)
    left = found.get("left")
    return left if isinstance(left, dict) and found.get("content") == content and found.get("results") == _results(folder) else None


def _results(folder: Path) -> dict[str, str]:
    """Return the content hash of each result of a step that its folder holds: what was damaged or written by another run is told."""
    return {name: digest(folder / name) for name in RESULTS if (folder / name).is_file()}


def _done_file(folder: Path) -> dict[str, Any]:
    """Return what the file of a step that is done says; nothing where there is none that can be read."""
    try:
        found = json.loads((folder / DONE_FILE).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) and found.get("schema") == DONE_SCHEMA else {}


def do_step(folder: Path, content: str, work: Callable[[], dict[str, Any]]) -> tuple[dict[str, Any], bool]:
    """Do a step unless it is done from this content, and say what it leaves for others, as plain data, and whether it was done before."""
    left = done(folder, content)
    if left is not None:
        return left, True
    (folder / DONE_FILE).unlink(missing_ok=True)
    left = work()
    said = {"schema": DONE_SCHEMA, "content": content, "results": _results(folder), "left": left}
    write_text(folder / DONE_FILE, json.dumps(said) + "\n")
    return left, False


def left_by(folder: Path) -> dict[str, Any]:
    """Return what a step that is done has left for others; nothing where its file is not there."""
    left = _done_file(folder).get("left")
    return left if isinstance(left, dict) else {}


def step_report(folder: Path) -> dict[str, Any]:
    """Return the report of a step that is done."""
    try:
        found = json.loads((folder / REPORT_FILE).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ResultError(f"{folder / REPORT_FILE}: cannot be read: delete the folder and run again") from error
    return found if isinstance(found, dict) else {}


def shared_lights(request: SolveRequest) -> LightsOverTime:
    """Return what the steps of a solve share, before the first; lights may not be found from the images of each step."""
    if request.lights is not LightsKnown.DECLARED:
        raise RequestError(f"--lights {request.lights}: each step of a sequence would find lights of its own, and the surfaces would not "
                           "fit each other: measure the lights once (relit calibrate), and write them into every step")
    return LightsOverTime(shared=request.intensities is Intensities.CHOSEN)


def request_of_step(request: AnyRequest, step: TimeStep) -> AnyRequest:
    """Return the request of one step alone, whose capture is looked at."""
    Capture.open(step.folder, request.pixels)
    changes: dict[str, Any] = {"capture": step.folder, "out": result_folder(request, step), "frame_rate": None, "temporal": True}
    if request.cache is not None:
        changes["cache"] = request.cache / step.name
    return request.model_copy(update=changes)


def solve_alone(request: SolveRequest, step: TimeStep, progress: Progress, lights: LightsOverTime,
                sharing: SharedSolve | None = None) -> tuple[SolveRequest, bool]:
    """Solve one step of a sequence unless it is done.
    `lights`: what the steps before have found; takes what this one finds. Returns the request of the step, and whether it was done
    before."""
    there = request_of_step(request, step)

    def work() -> dict[str, Any]:
        solve(there, progress, sharing=sharing, over_time=lights)
        return lights.left()

    left, was_done = do_step(there.out, capture_digest(step.folder, there, lights.plain()), work)
    lights.take(left)
    return there, was_done


def depth_alone(request: DepthRequest, step: TimeStep, progress: Progress) -> tuple[DepthRequest, bool]:
    """Measure the depth of one step unless it is done; arguments and result are those of solve_alone."""
    there = request_of_step(request, step)

    def work() -> dict[str, Any]:
        depth(there, progress)
        return {}

    _, was_done = do_step(there.out, capture_digest(step.folder, there, None), work)
    return there, was_done


def solve_number(request: SolveRequest, number: int, progress: Progress, sharing: SharedSolve | None = None) -> None:
    """Solve one step alone, by its number from 1, for a caller who does the steps in order, and then calls solve_sequence.

    `sharing` is the part of this process where several share the solve. Errors are those of solve_sequence.
    """
    sequence = _checked(request, number)
    lights = _lights_before(request, sequence, number)
    solve_alone(request, sequence.steps[number - 1], StepProgress(progress, number, len(sequence.steps)), lights, sharing)


def help_solve_number(request: SolveRequest, number: int, progress: Progress, sharing: SharedSolve) -> None:
    """Do pieces of what solve_number does in another process; arguments and errors are those of help_solve."""
    sequence = _checked(request, number)
    lights = _lights_before(request, sequence, number)
    help_solve(request_of_step(request, sequence.steps[number - 1]), StepProgress(progress, number, len(sequence.steps)), sharing,
               over_time=lights)


def depth_number(request: DepthRequest, number: int, progress: Progress) -> None:
    """Measure the depth of one step alone, as solve_number does a solve."""
    sequence = _checked(request, number)
    depth_alone(request, sequence.steps[number - 1], StepProgress(progress, number, len(sequence.steps)))


def _checked(request: SolveRequest | DepthRequest, number: int) -> Sequence:
    """Return the sequence, all of which is checked before its first step, and one step with the first before another."""
    sequence = read_sequence(request.capture, frames_per_second=request.frame_rate)
    step = sequence.step(number, request.capture)
    check_alike(sequence if number == 1 else sequence._replace(steps=(sequence.steps[0], step)))
    check_outputs(request.out, sequence)
    return sequence


def _lights_before(request: SolveRequest, sequence: Sequence, number: int) -> LightsOverTime:
    """Return what the steps before a step have found, which the last of them has left."""
    lights = shared_lights(request)
    if number > 1:
        lights.take(left_by(result_folder(request, sequence.steps[number - 2])))
    return lights


def result_folder(request: SolveRequest | DepthRequest, step: TimeStep) -> Path:
    """Return the folder of what is found of a step alone."""
    return request.out / step.name / ALONE if request.temporal else request.out / step.name
