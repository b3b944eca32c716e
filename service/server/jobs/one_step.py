"""Jobs of one step: each calls a product with the files of the captures, environments and jobs that its request names.

Those that calibrate write manifests and reports among the results, and leave the captures as they are.
"""

from collections.abc import Callable
from pkgutil import resolve_name
from typing import Any

from service.requests import calibrate, calibration_jobs, jobs
from service.requests.base.base import JobRequest, Options
from service.requests.basis import BasisKind, BasisRequest
from service.requests.captures import ViewRequest
from service.requests.chart import ChartRequest
from service.requests.depth import ScanRequest, SeparateRequest
from service.requests.drive import DriveRequest
from service.requests.export import ExportRequest
from service.requests.inspect_board import GaugeBoardRequest, InspectBoardRequest
from service.requests.patterns import PatternsRequest
from service.requests.rig import RigCalibrationRequest
from service.requests.shade import ShadeRequest
from service.requests.solve import JoinRequest
from service.server.jobs.context import StepFiles, file_within
from service.server.storage import layout
from stage.capture.manifest import FILE_NAME
from stage.capture.sequence import read_sequence
from stage.files import write_text

BASIS = "basis"
"""Name of the file of a basis, without its suffix."""
MEASURED_FILE = "measured.json"
"""Name of the file of a rig whose lamps were measured."""
STUDY_FILE = "study.json"
TOF_FILE = "tof.json"
"""Name of the calibration of a time-of-flight camera."""


def _product(function: str, model: type[Options], file: str = "", *, capture_as: str | None = None, **given: Any
             ) -> Callable[[Any, StepFiles], None]:
    """Return the function of jobs whose product, a `module:function` that is loaded when it is called, is given nothing but its request.
    `capture_as`: the field for the folder of the job's capture, where the request of the product has another word for it."""
    def make(request: Any, files: StepFiles) -> None:
        captured = {} if capture_as is None else {capture_as: files.intake(request.capture)}
        files.tell(resolve_name(function)(files.request(model, request, out=files.out / file, **captured, **given), files.progress))

    return make


def _rig(function: str, model: type[Options]) -> Callable[[Any, StepFiles], None]:
    """Return the function of jobs whose product calibrates the devices of a rig, and writes a manifest for each capture."""
    def make(request: Any, files: StepFiles) -> None:
        captures = getattr(request, "captures", None) or (request.capture,)
        manifests = [files.out / f"{capture}.{FILE_NAME}" for capture in (*captures, *request.apply_to)]
        files.tell(resolve_name(function)(files.request(model, request), files.progress, manifest_paths=manifests))

    return make


def export(request: jobs.ExportJob, files: StepFiles) -> None:
    """Make an asset of solved maps or a depth."""
    from service.export.export import export as make_asset

    files.tell(make_asset(files.request(ExportRequest, request, out=files.out / f"{layout.ASSET}.{request.format}"), files.progress))
    files.write_annotations(request.rig or request.maps)


def _view(request: jobs.ViewJob, files: StepFiles) -> None:
    from service.viewing.view_files import view

    capture, cache = files.intake(request.capture, request.step), files.cache(request.capture)
    maps = None if request.maps is None else files.maps(request.maps)
    if request.step is not None:
        capture = read_sequence(capture).step(request.step, capture).folder
        cache, maps = cache / capture.name, None if maps is None else maps / capture.name
    view(files.request(ViewRequest, request, capture=capture, maps=maps, out=files.out, cache=cache), files.progress)


def _basis(request: jobs.BasisJob, files: StepFiles) -> None:
    from service.basis.basis import SUFFIXES, make_basis

    kind = BasisKind(request.options.basis)
    options = {name: value for name, value in dict(request.options).items() if name != "basis"}
    files.tell(make_basis(BasisRequest(capture=files.intake(request.capture), out=files.out / f"{BASIS}{SUFFIXES[kind]}", kind=kind,
                                       device=files.context.device, cache=files.cache(request.capture), **options), files.progress))


def _patterns(request: jobs.PatternsJob, files: StepFiles) -> None:
    from service.depth.patterns.projection import make_patterns

    options = request.options.model_dump(exclude_defaults=True)  # options of other codes are refused if they are given
    make_patterns(PatternsRequest(out=files.out, **options), files.progress)


def _gauge_board(request: jobs.GaugeBoardJob, files: StepFiles) -> None:
    from service.boards.gauge_board import gauge_board

    with files.linked((run.result for run in request.study.runs), files.job.id) as folder:
        write_text(folder / STUDY_FILE, request.study.model_dump_json(by_alias=True))
        files.tell(gauge_board(GaugeBoardRequest(study=folder / STUDY_FILE, out=files.out), files.progress))


def _calibrate_tof(request: calibration_jobs.TofCalibrationJob, files: StepFiles) -> None:
    from service.calibrate.tof import calibrate_tof
    from service.relight.time_steps import time_steps

    folder = files.intake(request.capture)
    sweep = file_within(folder, request.sweep, "sweep")
    files.tell(calibrate_tof(calibrate.TofCalibrationRequest(sweep=sweep, out=files.out / TOF_FILE, device=files.context.device),
                             files.progress, allowed=time_steps(folder)))


MEASURE = "measure"
MEASURED: dict[type[JobRequest], Callable[[Any, StepFiles], None]] = {
    calibration_jobs.MirrorBallJob: _product("service.calibrate.lights:mirror_ball", calibrate.MirrorBallRequest, FILE_NAME),
    calibration_jobs.LightPositionsJob: _product("service.calibrate.lights:light_positions", calibrate.LightPositionsRequest, FILE_NAME),
    calibration_jobs.GreyBallJob: _product("service.calibrate.lights:grey_ball", calibrate.GreyBallRequest, FILE_NAME),
    calibration_jobs.IntensityJob: _product("service.calibrate.lights:intensity", calibrate.IntensityRequest, FILE_NAME),
    calibration_jobs.DarkJob: _product("service.calibrate.sensor:dark", calibrate.DarkRequest, FILE_NAME),
    calibration_jobs.FlatFieldJob: _product("service.calibrate.sensor:flat_field", calibrate.FlatFieldRequest, FILE_NAME),
    calibration_jobs.SaturationJob: _product("service.calibrate.sensor:saturation", calibrate.SaturationRequest, FILE_NAME, write=True),
    calibration_jobs.WhiteBalanceJob: _product("service.calibrate.sensor:white_balance", calibrate.WhiteBalanceRequest, FILE_NAME),
    calibration_jobs.ResponseJob: _product("service.calibrate.response:response", calibrate.ResponseRequest, FILE_NAME),
    calibration_jobs.ChartJob: _product("service.calibrate.chart:calibrate_chart", ChartRequest, FILE_NAME),
    calibration_jobs.RigCalibrationJob: _product("service.calibrate.rig_lamps:calibrate_rig", RigCalibrationRequest, MEASURED_FILE),
    calibration_jobs.ProcamJob: _rig("service.calibrate.procam:procam", calibrate.ProcamRequest),
    calibration_jobs.StereoCalibrationJob: _rig("service.calibrate.stereo:stereo", calibrate.StereoRequest),
    calibration_jobs.LaserPlanesJob: _rig("service.calibrate.laser_planes:laser_planes", calibrate.LaserPlanesRequest),
    calibration_jobs.TofCalibrationJob: _calibrate_tof, jobs.BasisJob: _basis, jobs.PatternsJob: _patterns,
    jobs.ScanJob: _product("service.depth.scan:scan", ScanRequest, capture_as="scan"),
    jobs.SeparateJob: _product("service.depth.separate:separate", SeparateRequest)}
"""The functions of the kinds of jobs whose step is MEASURE."""
ONE_STEP: dict[type[JobRequest], tuple[str, Callable[[Any, StepFiles], None]]] = {
    **{kind: (MEASURE, do) for kind, do in MEASURED.items()},
    jobs.ExportJob: ("export", export), jobs.JoinJob: ("join", _product("service.joining.join:join", JoinRequest)),
    jobs.ShadeJob: ("shade", _product("service.relight.shade:shade", ShadeRequest, layout.PICTURE)), jobs.ViewJob: ("view", _view),
    jobs.InspectBoardJob: ("inspect", _product("service.boards.inspect_board:inspect_board", InspectBoardRequest, capture_as="board")),
    jobs.GaugeBoardJob: ("gauge", _gauge_board), jobs.DriveJob: ("drive", _product("service.drive.drive:drive", DriveRequest))}
"""The name of the step of each of these kinds of jobs, and the function that does it."""
