"""Steps of the jobs that calibrate: they write manifests and reports among the results, and leave the captures as they are."""

from typing import Any

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
from service.requests.job import JobRequest
from service.server.jobs.measuring import Measure, Measurement
from service.server.jobs.named_files import file_within, files_within
from stage.manifest import FILE_NAME

TOF_FILE = "tof.json"
"""Name of the calibration of a time-of-flight camera."""


def _lights(request: CalibrationJob, given: Measurement) -> None:
    from service.calibrate.intensity import intensity
    from service.calibrate.lights import grey_ball, light_positions, mirror_ball
    from service.requests.calibrate import GreyBallRequest, IntensityRequest, LightPositionsRequest, MirrorBallRequest

    capture = given.intake(request.capture)
    values: dict[str, Any] = {"capture": capture, "apply_to": None if request.apply_to is None else given.intake(request.apply_to),
                              "out": given.out / FILE_NAME}
    if isinstance(request, BallJob):
        values["masks"] = files_within(capture, request.masks, "masks")
    if isinstance(request, MirrorBallJob):
        mirror_ball(MirrorBallRequest(**values, **dict(request.options)), given.progress)
    elif isinstance(request, LightPositionsJob):
        light_positions(LightPositionsRequest(**values, **dict(request.options)), given.progress)
    elif isinstance(request, GreyBallJob):
        grey_ball(GreyBallRequest(**values, **dict(request.options)), given.progress)
    else:
        assert isinstance(request, IntensityJob), request
        intensity(IntensityRequest(**values, **dict(request.options)), given.progress)


def _sensor(request: DarkJob | FlatFieldJob | SaturationJob, given: Measurement) -> None:
    from service.calibrate.images import dark, flat_field, saturation
    from service.requests.calibrate import DarkRequest, FlatFieldRequest, SaturationRequest

    capture, manifest = given.intake(request.capture), given.out / FILE_NAME
    if isinstance(request, DarkJob):
        dark(DarkRequest(capture=capture, images=files_within(capture, request.images, "images"), out=manifest), given.progress)
    elif isinstance(request, FlatFieldJob):
        flat_field(FlatFieldRequest(capture=capture, images=files_within(capture, request.images, "images"), out=manifest,
                                    dark_images=files_within(capture, request.dark_images, "dark_images")), given.progress)
    else:
        saturation(SaturationRequest(capture=capture, write=True, out=manifest), given.progress)


def _procam(request: ProcamJob, given: Measurement) -> None:
    from service.calibrate.procam import procam
    from service.requests.calibrate import ProcamRequest

    names = (*request.captures, *request.apply_to)
    procam(ProcamRequest(captures=given.intakes(request.captures), apply_to=given.intakes(request.apply_to), device=given.device,
                         cache=given.cache / request.captures[0], **dict(request.options)), given.progress,
           manifest_paths=[given.out / f"{name}.{FILE_NAME}" for name in names])


def _stereo(request: StereoCalibrationJob, given: Measurement) -> None:
    from service.calibrate.stereo import stereo
    from service.requests.calibrate import StereoRequest

    names = request.capture, *request.apply_to
    stereo(StereoRequest(capture=given.intake(request.capture), apply_to=given.intakes(request.apply_to), **dict(request.options)),
           given.progress, manifest_paths=[given.out / f"{name}.{FILE_NAME}" for name in names])


def _laser_planes(request: LaserPlanesJob, given: Measurement) -> None:
    from service.calibrate.laser_planes import laser_planes
    from service.requests.calibrate import LaserPlanesRequest

    names = (*request.captures, *request.apply_to)
    laser_planes(LaserPlanesRequest(captures=given.intakes(request.captures), apply_to=given.intakes(request.apply_to),
                                    device=given.device, **dict(request.options)), given.progress,
                 manifest_paths=[given.out / f"{name}.{FILE_NAME}" for name in names])


def _white_balance(request: WhiteBalanceJob, given: Measurement) -> None:
    from service.calibrate.white_balance import white_balance
    from service.requests.calibrate import WhiteBalanceRequest

    capture = given.intake(request.capture)
    white_balance(WhiteBalanceRequest(capture=capture, images=files_within(capture, request.images, "images"), out=given.out / FILE_NAME,
                                      **dict(request.options)), given.progress)


def _response(request: ResponseJob, given: Measurement) -> None:
    from service.calibrate.response import response
    from service.requests.calibrate import ResponseRequest

    capture = given.intake(request.capture)
    response(ResponseRequest(capture=capture, images=files_within(capture, request.images, "images"), out=given.out / FILE_NAME,
                             **dict(request.options)), given.progress)


def _tof(request: TofCalibrationJob, given: Measurement) -> None:
    from service.calibrate.tof import calibrate_tof
    from service.light.time_steps import time_steps
    from service.requests.calibrate import TofCalibrationRequest

    folder = given.intake(request.capture)
    sweep = file_within(folder, request.sweep, "sweep")
    calibrate_tof(TofCalibrationRequest(sweep=sweep, out=given.out / TOF_FILE, device=given.device), given.progress,
                  allowed=time_steps(folder))


CALIBRATIONS: dict[type[JobRequest], Measure] = {
    MirrorBallJob: _lights, LightPositionsJob: _lights, GreyBallJob: _lights, IntensityJob: _lights,
    DarkJob: _sensor, FlatFieldJob: _sensor, SaturationJob: _sensor, WhiteBalanceJob: _white_balance, ResponseJob: _response,
    ProcamJob: _procam, StereoCalibrationJob: _stereo, LaserPlanesJob: _laser_planes, TofCalibrationJob: _tof}
"""What does the jobs of each of these kinds."""
