"""Steps of the jobs that calibrate: they write manifests and reports among the results, and leave the captures as they are."""

from pathlib import Path
from typing import Any

from service.reporting.progress import Progress
from service.requests.calibration_jobs import (
    AnyCalibration,
    BallJob,
    CalibrationJob,
    DarkJob,
    FlatFieldJob,
    GreyBallJob,
    IntensityJob,
    LaserPlanesJob,
    LightPositionsJob,
    MirrorBallJob,
    ProcamJob,
    ResponseJob,
    SaturationJob,
    StereoCalibrationJob,
    TofCalibrationJob,
    WhiteBalanceJob,
)
from service.requests.job import JobRequest
from service.server.jobs.measuring import Intake
from service.server.jobs.named_files import file_within, files_within
from stage.manifest import FILE_NAME

TOF_FILE = "tof.json"
"""Name of the calibration of a time-of-flight camera."""


def can_run(request: JobRequest) -> bool:
    """Return whether a job calibrates."""
    return isinstance(request, AnyCalibration)


def run(request: JobRequest, out: Path, intake: Intake, *, device: str, cache: Path, progress: Progress) -> None:
    """Do a job that calibrates.

    Args:
        request: of the job.
        out: folder of the results.
        intake: returns the folder of a capture of the job's project.
        device: of the worker.
        cache: folder of the image stacks, one for each capture.
        progress: of the step.
    """
    if isinstance(request, CalibrationJob):
        _lights(request, out, intake, progress)
    elif isinstance(request, ProcamJob):
        _procam(request, out, intake, device, cache, progress)
    elif isinstance(request, StereoCalibrationJob):
        _stereo(request, out, intake, progress)
    elif isinstance(request, LaserPlanesJob):
        _laser_planes(request, out, intake, device, progress)
    elif isinstance(request, WhiteBalanceJob):
        _white_balance(request, out, intake, progress)
    elif isinstance(request, ResponseJob):
        _response(request, out, intake, progress)
    elif isinstance(request, TofCalibrationJob):
        _tof(request, out, intake, device, progress)
    else:
        assert isinstance(request, DarkJob | FlatFieldJob | SaturationJob), request
        _sensor(request, out, intake, progress)


def _lights(request: CalibrationJob, out: Path, intake: Intake, progress: Progress) -> None:
    from service.calibrate.intensity import intensity
    from service.calibrate.lights import grey_ball, light_positions, mirror_ball
    from service.requests.calibrate import GreyBallRequest, IntensityRequest, LightPositionsRequest, MirrorBallRequest

    capture = intake(request.capture)
    values: dict[str, Any] = {"capture": capture, "apply_to": None if request.apply_to is None else intake(request.apply_to),
                              "out": out / FILE_NAME}
    if isinstance(request, BallJob):
        values["masks"] = files_within(capture, request.masks, "masks")
    if isinstance(request, MirrorBallJob):
        mirror_ball(MirrorBallRequest(**values, **dict(request.options)), progress)
    elif isinstance(request, LightPositionsJob):
        light_positions(LightPositionsRequest(**values, **dict(request.options)), progress)
    elif isinstance(request, GreyBallJob):
        grey_ball(GreyBallRequest(**values, **dict(request.options)), progress)
    else:
        assert isinstance(request, IntensityJob), request
        intensity(IntensityRequest(**values, **dict(request.options)), progress)


def _sensor(request: DarkJob | FlatFieldJob | SaturationJob, out: Path, intake: Intake, progress: Progress) -> None:
    from service.calibrate.images import dark, flat_field, saturation
    from service.requests.calibrate import DarkRequest, FlatFieldRequest, SaturationRequest

    capture, manifest = intake(request.capture), out / FILE_NAME
    if isinstance(request, DarkJob):
        dark(DarkRequest(capture=capture, images=files_within(capture, request.images, "images"), out=manifest), progress)
    elif isinstance(request, FlatFieldJob):
        flat_field(FlatFieldRequest(capture=capture, images=files_within(capture, request.images, "images"), out=manifest,
                                    dark_images=files_within(capture, request.dark_images, "dark_images")), progress)
    else:
        saturation(SaturationRequest(capture=capture, write=True, out=manifest), progress)


def _procam(request: ProcamJob, out: Path, intake: Intake, device: str, cache: Path, progress: Progress) -> None:
    from service.calibrate.procam import procam
    from service.requests.calibrate import ProcamRequest

    names = (*request.captures, *request.apply_to)
    procam(ProcamRequest(captures=tuple(map(intake, request.captures)), apply_to=tuple(map(intake, request.apply_to)), device=device,
                         cache=cache / request.captures[0], **dict(request.options)), progress,
           manifest_paths=[out / f"{name}.{FILE_NAME}" for name in names])


def _stereo(request: StereoCalibrationJob, out: Path, intake: Intake, progress: Progress) -> None:
    from service.calibrate.stereo import stereo
    from service.requests.calibrate import StereoRequest

    names = request.capture, *request.apply_to
    stereo(StereoRequest(capture=intake(request.capture), apply_to=tuple(map(intake, request.apply_to)), **dict(request.options)), progress,
           manifest_paths=[out / f"{name}.{FILE_NAME}" for name in names])


def _laser_planes(request: LaserPlanesJob, out: Path, intake: Intake, device: str, progress: Progress) -> None:
    from service.calibrate.laser_planes import laser_planes
    from service.requests.calibrate import LaserPlanesRequest

    names = (*request.captures, *request.apply_to)
    laser_planes(LaserPlanesRequest(captures=tuple(map(intake, request.captures)), apply_to=tuple(map(intake, request.apply_to)),
                                    device=device, **dict(request.options)), progress,
                 manifest_paths=[out / f"{name}.{FILE_NAME}" for name in names])


def _white_balance(request: WhiteBalanceJob, out: Path, intake: Intake, progress: Progress) -> None:
    from service.calibrate.white_balance import white_balance
    from service.requests.calibrate import WhiteBalanceRequest

    capture = intake(request.capture)
    white_balance(WhiteBalanceRequest(capture=capture, images=files_within(capture, request.images, "images"), out=out / FILE_NAME,
                                      **dict(request.options)), progress)


def _response(request: ResponseJob, out: Path, intake: Intake, progress: Progress) -> None:
    from service.calibrate.response import response
    from service.requests.calibrate import ResponseRequest

    capture = intake(request.capture)
    response(ResponseRequest(capture=capture, images=files_within(capture, request.images, "images"), out=out / FILE_NAME,
                             **dict(request.options)), progress)


def _tof(request: TofCalibrationJob, out: Path, intake: Intake, device: str, progress: Progress) -> None:
    from service.calibrate.tof import calibrate_tof
    from service.light.sequence import time_steps
    from service.requests.calibrate import TofCalibrationRequest

    folder = intake(request.capture)
    sweep = file_within(folder, request.sweep, "sweep")
    calibrate_tof(TofCalibrationRequest(sweep=sweep, out=out / TOF_FILE, device=device), progress, allowed=time_steps(folder))
