"""Jobs that calibrate, in one step: they write manifests and reports among the results, and leave the captures as they are."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from service.requests.base.base import JobRequest
from service.requests.calibration_jobs import (
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
from service.server.jobs.places import StepFiles, file_within, files_within
from stage.capture.manifest import FILE_NAME

TOF_FILE = "tof.json"
"""Name of the calibration of a time-of-flight camera."""


def _lights(request: CalibrationJob, files: StepFiles) -> None:
    from service.calibrate.intensity import intensity
    from service.calibrate.lights import grey_ball, light_positions, mirror_ball
    from service.requests.calibrate import GreyBallRequest, IntensityRequest, LightPositionsRequest, MirrorBallRequest

    capture = files.intake(request.capture)
    values: dict[str, Any] = {"capture": capture, "apply_to": None if request.apply_to is None else files.intake(request.apply_to),
                              "out": files.out / FILE_NAME}
    if isinstance(request, BallJob):
        values["masks"] = files_within(capture, request.masks, "masks")
    if isinstance(request, MirrorBallJob):
        mirror_ball(MirrorBallRequest(**values, **dict(request.options)), files.progress)
    elif isinstance(request, LightPositionsJob):
        light_positions(LightPositionsRequest(**values, **dict(request.options)), files.progress)
    elif isinstance(request, GreyBallJob):
        grey_ball(GreyBallRequest(**values, **dict(request.options)), files.progress)
    else:
        assert isinstance(request, IntensityJob), request
        intensity(IntensityRequest(**values, **dict(request.options)), files.progress)


def _images(request: DarkJob | FlatFieldJob | SaturationJob | WhiteBalanceJob | ResponseJob, files: StepFiles) -> None:
    from service.calibrate.images import dark, flat_field, saturation
    from service.calibrate.response import response
    from service.calibrate.white_balance import white_balance
    from service.requests.calibrate import DarkRequest, FlatFieldRequest, ResponseRequest, SaturationRequest, WhiteBalanceRequest

    capture = files.intake(request.capture)
    values: dict[str, Any] = {"capture": capture, "out": files.out / FILE_NAME}
    if isinstance(request, SaturationJob):
        saturation(SaturationRequest(**values, write=True), files.progress)
        return
    values["images"] = files_within(capture, request.images, "images")
    if isinstance(request, DarkJob):
        dark(DarkRequest(**values), files.progress)
    elif isinstance(request, FlatFieldJob):
        flat_field(FlatFieldRequest(**values, dark_images=files_within(capture, request.dark_images, "dark_images")), files.progress)
    elif isinstance(request, WhiteBalanceJob):
        white_balance(WhiteBalanceRequest(**values, **dict(request.options)), files.progress)
    else:
        response(ResponseRequest(**values, **dict(request.options)), files.progress)


def _procam(request: ProcamJob, files: StepFiles) -> None:
    from service.calibrate.procam import procam
    from service.requests.calibrate import ProcamRequest

    procam(ProcamRequest(captures=files.intakes(request.captures), apply_to=files.intakes(request.apply_to), device=files.device,
                         cache=files.cache(request.captures[0]), **dict(request.options)), files.progress,
           manifest_paths=_manifests(files, *request.captures, *request.apply_to))


def _stereo(request: StereoCalibrationJob, files: StepFiles) -> None:
    from service.calibrate.stereo import stereo
    from service.requests.calibrate import StereoRequest

    stereo(StereoRequest(capture=files.intake(request.capture), apply_to=files.intakes(request.apply_to), **dict(request.options)),
           files.progress, manifest_paths=_manifests(files, request.capture, *request.apply_to))


def _laser_planes(request: LaserPlanesJob, files: StepFiles) -> None:
    from service.calibrate.laser_planes import laser_planes
    from service.requests.calibrate import LaserPlanesRequest

    laser_planes(LaserPlanesRequest(captures=files.intakes(request.captures), apply_to=files.intakes(request.apply_to),
                                    device=files.device, **dict(request.options)), files.progress,
                 manifest_paths=_manifests(files, *request.captures, *request.apply_to))


def _tof(request: TofCalibrationJob, files: StepFiles) -> None:
    from service.calibrate.tof import calibrate_tof
    from service.relight.time_steps import time_steps
    from service.requests.calibrate import TofCalibrationRequest

    folder = files.intake(request.capture)
    sweep = file_within(folder, request.sweep, "sweep")
    calibrate_tof(TofCalibrationRequest(sweep=sweep, out=files.out / TOF_FILE, device=files.device), files.progress,
                  allowed=time_steps(folder))


def _manifests(files: StepFiles, *captures: str) -> list[Path]:
    """Return the files for the manifests of captures."""
    return [files.out / f"{capture}.{FILE_NAME}" for capture in captures]


CALIBRATIONS: dict[type[JobRequest], Callable[[Any, StepFiles], None]] = {
    MirrorBallJob: _lights, LightPositionsJob: _lights, GreyBallJob: _lights, IntensityJob: _lights,
    DarkJob: _images, FlatFieldJob: _images, SaturationJob: _images, WhiteBalanceJob: _images, ResponseJob: _images,
    ProcamJob: _procam, StereoCalibrationJob: _stereo, LaserPlanesJob: _laser_planes, TofCalibrationJob: _tof}
"""The function that does the jobs of each of these kinds."""
