"""Steps of the jobs that make no maps: bases, scans, patterns to project, and calibrations of lights."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from service.errors import RequestError
from service.reporting.progress import Progress
from service.requests.basis import BasisKind
from service.requests.jobs import (
    BallJob,
    BasisJob,
    CalibrationJob,
    GreyBallJob,
    IntensityJob,
    JobRequest,
    LightPositionsJob,
    MirrorBallJob,
    PatternsJob,
    ScanJob,
)
from stage.files import resolved
from stage.manifest import FILE_NAME

BASIS = "basis"
"""Name of the file of a basis, without its suffix."""
Intake = Callable[[str], Path]
"""Returns the folder of a capture, checked."""


def can_run(request: JobRequest) -> bool:
    """Return whether a job is one of these kinds."""
    return isinstance(request, BasisJob | ScanJob | PatternsJob | CalibrationJob)


def run(request: JobRequest, out: Path, intake: Intake, *, device: str, cache: Path, progress: Progress) -> None:
    """Do a job of one of these kinds.

    Args:
        request: of the job.
        out: folder of the results.
        intake: returns the folder of a capture of the job's project.
        device: of the worker.
        cache: folder of the image stacks, one for each capture.
        progress: of the step.
    """
    if isinstance(request, BasisJob):
        _basis(request, out, intake, device, cache, progress)
    elif isinstance(request, ScanJob):
        _scan(request, out, intake, device, progress)
    elif isinstance(request, PatternsJob):
        _patterns(request, out, progress)
    else:
        assert isinstance(request, CalibrationJob), request
        _calibrate(request, out, intake, progress)


def _basis(request: BasisJob, out: Path, intake: Intake, device: str, cache: Path, progress: Progress) -> None:
    from service.basis.basis import SUFFIXES, make_basis
    from service.requests.basis import BasisRequest

    kind = BasisKind(request.options.basis)
    options = {name: value for name, value in dict(request.options).items() if name != "basis"}
    make_basis(BasisRequest(capture=intake(request.capture), out=out / f"{BASIS}{SUFFIXES[kind]}", kind=kind, device=device,
                            cache=cache / request.capture, **options), progress)


def _scan(request: ScanJob, out: Path, intake: Intake, device: str, progress: Progress) -> None:
    from service.depth.scan import scan
    from service.requests.scan import ScanRequest

    scan(ScanRequest(scan=intake(request.capture), out=out, device=device, **dict(request.options)), progress)


def _patterns(request: PatternsJob, out: Path, progress: Progress) -> None:
    from service.depth.projection import make_patterns
    from service.requests.patterns import PatternsRequest

    given = request.options.model_dump(exclude_defaults=True)  # options of other codes are refused if they are given
    make_patterns(PatternsRequest(out=out, **given), progress)


def _calibrate(request: CalibrationJob, out: Path, intake: Intake, progress: Progress) -> None:
    from service.calibrate.intensity import intensity
    from service.calibrate.lights import grey_ball, light_positions, mirror_ball
    from service.requests.calibrate import GreyBallRequest, IntensityRequest, LightPositionsRequest, MirrorBallRequest

    capture = intake(request.capture)
    values: dict[str, Any] = {"capture": capture, "apply_to": None if request.apply_to is None else intake(request.apply_to),
                              "out": out / FILE_NAME}
    if isinstance(request, BallJob):
        values["masks"] = tuple(_within(capture, name) for name in request.masks)
    if isinstance(request, MirrorBallJob):
        mirror_ball(MirrorBallRequest(**values, **dict(request.options)), progress)
    elif isinstance(request, LightPositionsJob):
        light_positions(LightPositionsRequest(**values, **dict(request.options)), progress)
    elif isinstance(request, GreyBallJob):
        grey_ball(GreyBallRequest(**values, **dict(request.options)), progress)
    else:
        assert isinstance(request, IntensityJob), request
        intensity(IntensityRequest(**values, **dict(request.options)), progress)


def _within(capture: Path, name: str) -> Path:
    place = None if "\0" in name else resolved(capture / name)
    if place is None or not place.is_relative_to(capture.resolve()) or not place.is_file():
        raise RequestError(f"masks: {name!r} is no file of the capture")
    return capture / name
