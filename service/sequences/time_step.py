"""One step of a sequence from its own capture: what `relit solve` or `relit depth` finds of it alone."""

from pathlib import Path
from typing import Any, TypeVar

from service.depth.depth import depth
from service.errors import RequestError
from service.reporting.progress import Progress
from service.requests.depth import DepthRequest
from service.requests.solve import Intensities, LightsKnown, SolveRequest
from service.sequences.steps import ALONE, StepProgress, capture_digest, check_outputs, do_step, left_by
from service.sharing.sharing import SharedSolve
from service.solve.lights.intensities import LightsOverTime
from service.solve.solve import help_solve, solve
from stage.capture.capture import Capture
from stage.capture.sequence import Sequence, TimeStep, check_alike, read_sequence

AnyRequest = TypeVar("AnyRequest", SolveRequest, DepthRequest)


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

    Args:
        lights: what the steps before have found; takes what this one finds.

    Returns:
        The request of the step, and whether it was done before.
    """
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
