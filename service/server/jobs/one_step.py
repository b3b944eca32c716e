"""Jobs of one step: each calls a product with the files of the captures, environments and jobs that its request names.

Those that calibrate write manifests and reports among the results, and leave the captures as they are.
"""

import tempfile
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

from service.reporting.provenance import name_place
from service.requests import calibrate, calibration_jobs, jobs
from service.requests.base.base import JobRequest, Options
from service.requests.basis import BasisKind
from service.requests.depth import SeparateRequest
from service.requests.light.light_keys import LightKeys
from service.requests.shade import ShadeRequest
from service.requests.solve import JoinRequest
from service.server.jobs.places import StepFiles, file_within
from service.server.storage import layout
from stage.capture.manifest import FILE_NAME
from stage.capture.sequence import read_sequence
from stage.files import write_text

BASIS = "basis"
"""Name of the file of a basis, without its suffix."""
RIG_FILE, KEYS_FILE, CHART_FILE = "rig.json", "keys.json", "chart.json"
"""Names of the files with the rig and the light keys of a job, which lie beside what was made of them."""
MEASURED_FILE = "measured.json"
REGIONS_FILE = "regions.json"
"""Name of the file with the regions of a job, which lies beside what they were judged in."""
STUDY_FILE = "study.json"
TOF_FILE = "tof.json"
"""Name of the calibration of a time-of-flight camera."""


def _product(function: str, model: type[Options], file: str = "", **given: Any) -> Callable[[JobRequest, StepFiles], None]:
    """Return the function of jobs whose product, a `module:function` that is loaded when it is called, is given nothing but its request."""
    def make(request: JobRequest, files: StepFiles) -> None:
        module, _, name = function.partition(":")
        getattr(import_module(module), name)(files.request(model, request, out=files.out / file, **given), files.progress)

    return make


def export(request: jobs.ExportJob, files: StepFiles) -> None:
    """Make an asset of solved maps or a depth."""
    from service.export.export import export as make_asset
    from service.requests.export import ExportRequest

    make_asset(files.request(ExportRequest, request, out=files.out / f"{layout.ASSET}.{request.format}"), files.progress)
    files.write_annotations(request.rig or request.maps)


def _view(request: jobs.ViewJob, files: StepFiles) -> None:
    from service.requests.captures import ViewRequest
    from service.viewing.view_files import view

    capture, cache = files.intake(request.capture, request.step), files.cache(request.capture)
    maps = None if request.maps is None else files.maps(request.maps)
    if request.step is not None:
        capture = read_sequence(capture).step(request.step, capture).folder
        cache, maps = cache / capture.name, None if maps is None else maps / capture.name
    view(files.request(ViewRequest, request, capture=capture, maps=maps, out=files.out, cache=cache), files.progress)


def _basis(request: jobs.BasisJob, files: StepFiles) -> None:
    from service.basis.basis import SUFFIXES, make_basis
    from service.requests.basis import BasisRequest

    kind = BasisKind(request.options.basis)
    options = {name: value for name, value in dict(request.options).items() if name != "basis"}
    make_basis(BasisRequest(capture=files.intake(request.capture), out=files.out / f"{BASIS}{SUFFIXES[kind]}", kind=kind,
                            device=files.device, cache=files.cache(request.capture), **options), files.progress)


def _scan(request: jobs.ScanJob, files: StepFiles) -> None:
    from service.depth.scan import scan
    from service.requests.depth import ScanRequest

    scan(files.request(ScanRequest, request, scan=files.intake(request.capture), out=files.out), files.progress)


def _patterns(request: jobs.PatternsJob, files: StepFiles) -> None:
    from service.depth.patterns.projection import make_patterns
    from service.requests.patterns import PatternsRequest

    options = request.options.model_dump(exclude_defaults=True)  # options of other codes are refused if they are given
    make_patterns(PatternsRequest(out=files.out, **options), files.progress)


def _inspect_board(request: jobs.InspectBoardJob, files: StepFiles) -> None:
    from service.boards.inspect_board import inspect_board
    from service.requests.inspect_board import InspectBoardRequest

    regions = None
    if request.regions is not None:
        regions = files.out / REGIONS_FILE
        write_text(regions, request.regions.model_dump_json(by_alias=True, indent=2) + "\n")
    inspect_board(files.request(InspectBoardRequest, request, board=files.intake(request.capture), out=files.out, regions=regions),
                  files.progress)


def _drive(request: jobs.DriveJob, files: StepFiles) -> None:
    from service.drive.drive import drive
    from service.requests.drive import DriveRequest

    given: dict[str, Path | None] = {"rig": files.out / RIG_FILE, "chart": None if request.chart is None else files.out / CHART_FILE}
    for path, document in zip(given.values(), (request.rig, request.chart), strict=True):
        if path is not None and document is not None:
            write_text(path, document.model_dump_json(by_alias=True) + "\n")
    drive(files.request(DriveRequest, request, **given, keys=write_keys(request.keys, files), out=files.out), files.progress)


def write_keys(keys: LightKeys | None, files: StepFiles) -> Path | None:
    """Write the light keys of a job among its results and return their file, or None if it has none."""
    if keys is None:
        return None
    write_text(files.out / KEYS_FILE, keys.model_dump_json(by_alias=True, indent=2, exclude_defaults=True))
    return files.out / KEYS_FILE


def _gauge_board(request: jobs.GaugeBoardJob, files: StepFiles) -> None:
    from service.boards.gauge_board import gauge_board
    from service.requests.inspect_board import GaugeBoardRequest

    with tempfile.TemporaryDirectory(prefix="relit-gauge-") as made:
        folder = Path(made)
        name_place(folder, files.job.id)
        for run in request.study.runs:
            (folder / run.result).symlink_to(files.maps(run.result), target_is_directory=True)
        write_text(folder / STUDY_FILE, request.study.model_dump_json(by_alias=True))
        gauge_board(GaugeBoardRequest(study=folder / STUDY_FILE, out=files.out), files.progress)


def _calibrate_chart(request: calibration_jobs.ChartJob, files: StepFiles) -> None:
    from service.calibrate.chart import calibrate_chart
    from service.requests.chart import ChartRequest

    folder = files.intake(request.capture)
    reflectances = None if request.reflectances is None else file_within(folder, request.reflectances, "reflectances")
    calibrate_chart(files.request(ChartRequest, request, capture=folder, reflectances=reflectances, out=files.out / FILE_NAME),
                    files.progress)


def _calibrate_rig(request: calibration_jobs.ProcamJob | calibration_jobs.StereoCalibrationJob | calibration_jobs.LaserPlanesJob,
                   files: StepFiles) -> None:
    from service.calibrate import laser_planes, procam, stereo

    captures = [request.capture] if isinstance(request, calibration_jobs.StereoCalibrationJob) else request.captures
    paths = [files.out / f"{capture}.{FILE_NAME}" for capture in (*captures, *request.apply_to)]
    if isinstance(request, calibration_jobs.ProcamJob):
        procam.procam(files.request(calibrate.ProcamRequest, request), files.progress, manifest_paths=paths)
    elif isinstance(request, calibration_jobs.StereoCalibrationJob):
        stereo.stereo(files.request(calibrate.StereoRequest, request), files.progress, manifest_paths=paths)
    else:
        laser_planes.laser_planes(files.request(calibrate.LaserPlanesRequest, request), files.progress, manifest_paths=paths)


def _calibrate_lamps(request: calibration_jobs.RigCalibrationJob, files: StepFiles) -> None:
    from service.calibrate.rig_lamps import calibrate_rig
    from service.requests.rig import RigCalibrationRequest

    rig = files.out / RIG_FILE
    write_text(rig, request.rig.model_dump_json(by_alias=True) + "\n")
    folder = files.intake(request.capture)
    table = file_within(folder, request.table, "table")
    reflectances = None if request.reflectances is None else file_within(folder, request.reflectances, "reflectances")
    calibrate_rig(files.request(RigCalibrationRequest, request, rig=rig, table=table, reflectances=reflectances,
                                out=files.out / MEASURED_FILE, capture=folder), files.progress)


def _calibrate_tof(request: calibration_jobs.TofCalibrationJob, files: StepFiles) -> None:
    from service.calibrate.tof import calibrate_tof
    from service.relight.time_steps import time_steps

    folder = files.intake(request.capture)
    sweep = file_within(folder, request.sweep, "sweep")
    calibrate_tof(calibrate.TofCalibrationRequest(sweep=sweep, out=files.out / TOF_FILE, device=files.device), files.progress,
                  allowed=time_steps(folder))


MEASURE = "measure"
RIGS = (calibration_jobs.ProcamJob, calibration_jobs.StereoCalibrationJob, calibration_jobs.LaserPlanesJob)
ONE_STEP: dict[type[JobRequest], tuple[str, Callable[[Any, StepFiles], None]]] = {
    calibration_jobs.MirrorBallJob: (MEASURE, _product("service.calibrate.lights:mirror_ball", calibrate.MirrorBallRequest, FILE_NAME)),
    calibration_jobs.LightPositionsJob: (MEASURE, _product("service.calibrate.lights:light_positions", calibrate.LightPositionsRequest,
                                                           FILE_NAME)),
    calibration_jobs.GreyBallJob: (MEASURE, _product("service.calibrate.lights:grey_ball", calibrate.GreyBallRequest, FILE_NAME)),
    calibration_jobs.IntensityJob: (MEASURE, _product("service.calibrate.lights:intensity", calibrate.IntensityRequest, FILE_NAME)),
    calibration_jobs.DarkJob: (MEASURE, _product("service.calibrate.sensor:dark", calibrate.DarkRequest, FILE_NAME)),
    calibration_jobs.FlatFieldJob: (MEASURE, _product("service.calibrate.sensor:flat_field", calibrate.FlatFieldRequest, FILE_NAME)),
    calibration_jobs.SaturationJob: (MEASURE, _product("service.calibrate.sensor:saturation", calibrate.SaturationRequest, FILE_NAME,
                                                       write=True)),
    calibration_jobs.WhiteBalanceJob: (MEASURE, _product("service.calibrate.sensor:white_balance", calibrate.WhiteBalanceRequest,
                                                         FILE_NAME)),
    calibration_jobs.ResponseJob: (MEASURE, _product("service.calibrate.response:response", calibrate.ResponseRequest, FILE_NAME)),
    **dict.fromkeys(RIGS, (MEASURE, _calibrate_rig)), calibration_jobs.TofCalibrationJob: (MEASURE, _calibrate_tof),
    calibration_jobs.RigCalibrationJob: (MEASURE, _calibrate_lamps), calibration_jobs.ChartJob: (MEASURE, _calibrate_chart),
    jobs.ExportJob: ("export", export), jobs.JoinJob: ("join", _product("service.joining.join:join", JoinRequest)),
    jobs.ShadeJob: ("shade", _product("service.relight.shade:shade", ShadeRequest, layout.PICTURE)), jobs.ViewJob: ("view", _view),
    jobs.InspectBoardJob: ("inspect", _inspect_board), jobs.GaugeBoardJob: ("gauge", _gauge_board), jobs.DriveJob: ("drive", _drive),
    jobs.BasisJob: (MEASURE, _basis), jobs.ScanJob: (MEASURE, _scan), jobs.PatternsJob: (MEASURE, _patterns),
    jobs.SeparateJob: (MEASURE, _product("service.depth.separate:separate", SeparateRequest))}
"""The name of the step of each of these kinds of jobs, and the function that does it."""
