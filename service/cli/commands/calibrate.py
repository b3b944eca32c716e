"""relit calibrate KIND: lights, dark frame, flat field and saturation, projector and cameras, time of flight from images."""

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from service.cli.groups import make_group
from service.cli.printing import print_table, print_warnings
from service.cli.progress import with_bar
from service.cli.request_commands import local_command
from service.requests.calibrate import (
    DarkRequest,
    FlatFieldRequest,
    GreyBallRequest,
    IntensityRequest,
    LaserPlanesRequest,
    LightPositionsRequest,
    MirrorBallRequest,
    ProcamRequest,
    ResponseRequest,
    SaturationRequest,
    StereoRequest,
    TofCalibrationRequest,
    WhiteBalanceRequest,
)
from service.requests.chart import ChartRequest
from service.requests.rig import RigCalibrationRequest

if TYPE_CHECKING:
    from service.calibrate.results import LightCalibration
    from service.calibrate.sensor import ImageCalibration

LIGHT_ROWS = 12
"""The number of lights that the table shows; the report holds all."""
VIEW_ROWS = 40
"""The number of views that the table shows; the report holds all."""


def register(app: typer.Typer) -> None:
    """Add the command and its kinds."""
    kinds = make_group("calibrate",
                       help="Lights, projector and cameras, dark frame, flat field, colours and saturation from images; with residuals.")
    for function in (_mirror_ball, _light_positions, _grey_ball, _intensity, _dark, _flat_field, _saturation, _white_balance, _chart,
                     _procam, _stereo, _laser_planes, _response, _tof, _rig):
        local_command(kinds, function.__name__[1:].replace("_", "-"), function)
    app.add_typer(kinds)


def _mirror_ball(request: MirrorBallRequest) -> None:
    from service.calibrate.lights import mirror_ball

    _print_lights(with_bar(mirror_ball, request))


def _light_positions(request: LightPositionsRequest) -> None:
    from service.calibrate.lights import light_positions

    _print_lights(with_bar(light_positions, request))


def _grey_ball(request: GreyBallRequest) -> None:
    from service.calibrate.lights import grey_ball

    _print_lights(with_bar(grey_ball, request))


def _intensity(request: IntensityRequest) -> None:
    from service.calibrate.lights import intensity

    _print_lights(with_bar(intensity, request))


def _dark(request: DarkRequest) -> None:
    from service.calibrate.sensor import dark

    _print_image("dark", with_bar(dark, request))


def _flat_field(request: FlatFieldRequest) -> None:
    from service.calibrate.sensor import flat_field

    _print_image("flat", with_bar(flat_field, request))


def _saturation(request: SaturationRequest) -> None:
    from service.calibrate.sensor import saturation

    result = with_bar(saturation, request)
    print(f"level    {result.level:g}")
    print("readings " + ", ".join(f"{count} {name}" for count, name in zip(result.counts, ("red", "green", "blue"), strict=True)))
    if result.manifest_path is not None and result.report_path is not None:
        _print_files((result.manifest_path,), result.report_path)


def _white_balance(request: WhiteBalanceRequest) -> None:
    from service.calibrate.white_balance import white_balance

    result = with_bar(white_balance, request)
    _print_files((result.manifest_path,), result.report_path)
    print("gains    " + ", ".join(f"{gain:.4f} {name}" for gain, name in zip(result.gains, ("red", "green", "blue"), strict=True)))
    for row in result.matrix:
        print("matrix   " + " ".join(f"{value:9.5f}" for value in row))


def _chart(request: ChartRequest) -> None:
    from service.calibrate.chart import calibrate_chart

    result = with_bar(calibrate_chart, request)
    _print_files((result.manifest_path,), result.report_path)
    print(f"picture  {result.picture_path}")
    for kind in result.kinds:
        print(f"colours  {kind.summary}")
        for row in kind.colors.matrix:
            print("matrix   " + " ".join(f"{value:9.5f}" for value in row))
        print_table([("patch", "before", "after", "remark"), *kind.rows[:LIGHT_ROWS]])
    print_warnings(result.warnings)


def _procam(request: ProcamRequest) -> None:
    from service.calibrate.procam import procam

    result = with_bar(procam, request)
    _print_files(result.manifest_paths, result.report_path)
    print(f"error    {result.rms_px:.3f} px RMS, baseline {result.baseline_m:.4f} m")
    print_table([("view", "camera, px", "projector, px", "remark"), *result.rows[:VIEW_ROWS]])


def _stereo(request: StereoRequest) -> None:
    from service.calibrate.stereo import stereo

    result = with_bar(stereo, request)
    _print_files(result.manifest_paths, result.report_path)
    print(f"error    {result.summary}")
    print_table([("frame", "other camera", "camera, px", "other, px", "remark"), *result.rows[:VIEW_ROWS]])


def _laser_planes(request: LaserPlanesRequest) -> None:
    from service.calibrate.laser_planes import laser_planes

    result = with_bar(laser_planes, request)
    _print_files(result.manifest_paths, result.report_path)
    print_table([("frame", "tilt sure to", "residual", "from" if request.step_m is None else "sure to"), *result.rows[:LIGHT_ROWS]])


def _response(request: ResponseRequest) -> None:
    from service.calibrate.response import response

    result = with_bar(response, request)
    print(f"capture  {result.manifest_path}")
    print(f"report   {result.report_path}")
    print(f"response nearest to level^{result.gamma:.2f}; pixels deviate by {100 * result.spread:.2g} % of full scale")


def _tof(request: TofCalibrationRequest) -> None:
    from service.calibrate.tof import calibrate_tof

    result = with_bar(calibrate_tof, request)
    print(f"file     {result.path}")
    drift = result.calibration.temperature
    found = [f"wiggling at {harmonics.modulation_hz / 1e6:g} MHz" for harmonics in result.calibration.harmonics]
    found += [f"scale {result.calibration.scale:.5g}", f"offset {1000 * result.calibration.offset_m:.2f} mm"]
    found += [] if drift is None else [f"drift {1000 * drift.metres_per_c:.3f} mm a degree"]
    print(f"found    {', '.join(found)}")
    print(f"error    {1000 * result.before_m:.2f} mm before, {1000 * result.after_m:.2f} mm after, RMS over {result.steps} steps")


def _rig(request: RigCalibrationRequest) -> None:
    from service.calibrate.rig_lamps import calibrate_rig

    result = with_bar(calibrate_rig, request)
    print(f"rig      {result.rig_path}")
    print(f"report   {result.report_path}")
    print(f"lamps    {result.summary}")
    print_table([result.headings, *result.rows[:LIGHT_ROWS]])
    if len(result.rows) > LIGHT_ROWS:
        print(f"… and {len(result.rows) - LIGHT_ROWS} that are surer")


def _print_files(manifest_paths: Iterable[Path], report_path: Path) -> None:
    for path in manifest_paths:
        print(f"capture  {path}")
    print(f"report   {report_path}")


def _print_lights(result: "LightCalibration") -> None:
    """Print where the results are, and the lights that are least sure."""
    _print_files((result.manifest_path,), result.report_path)
    print(f"lights   {result.summary}")
    print_table([result.headings, *result.rows[:LIGHT_ROWS]])
    if len(result.rows) > LIGHT_ROWS:
        print(f"… and {len(result.rows) - LIGHT_ROWS} that are surer")


def _print_image(name: str, result: "ImageCalibration") -> None:
    print(f"{name:<8} {result.image_path}")
    _print_files((result.manifest_path,), result.report_path)
