"""relit calibrate KIND: lights, dark frame, flat field and saturation, projector and cameras, time of flight from images."""

from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from service.cli.groups import make_group
from service.cli.printing import print_lines, print_table
from service.cli.request_commands import product_command
from service.requests import calibrate
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
    product_command(kinds, "mirror-ball", calibrate.MirrorBallRequest, "service.calibrate.lights:mirror_ball", _print_lights)
    product_command(kinds, "light-positions", calibrate.LightPositionsRequest, "service.calibrate.lights:light_positions", _print_lights)
    product_command(kinds, "grey-ball", calibrate.GreyBallRequest, "service.calibrate.lights:grey_ball", _print_lights)
    product_command(kinds, "intensity", calibrate.IntensityRequest, "service.calibrate.lights:intensity", _print_lights)
    product_command(kinds, "dark", calibrate.DarkRequest, "service.calibrate.sensor:dark", partial(_print_image, "dark"))
    product_command(kinds, "flat-field", calibrate.FlatFieldRequest, "service.calibrate.sensor:flat_field", partial(_print_image, "flat"))
    product_command(kinds, "saturation", calibrate.SaturationRequest, "service.calibrate.sensor:saturation", _saturation)
    product_command(kinds, "white-balance", calibrate.WhiteBalanceRequest, "service.calibrate.sensor:white_balance", _white_balance)
    product_command(kinds, "chart", ChartRequest, "service.calibrate.chart:calibrate_chart", _chart)
    product_command(kinds, "procam", calibrate.ProcamRequest, "service.calibrate.procam:procam", _procam)
    product_command(kinds, "stereo", calibrate.StereoRequest, "service.calibrate.stereo:stereo", _stereo)
    product_command(kinds, "laser-planes", calibrate.LaserPlanesRequest, "service.calibrate.laser_planes:laser_planes", _laser_planes)
    product_command(kinds, "response", calibrate.ResponseRequest, "service.calibrate.response:response", _response)
    product_command(kinds, "tof", calibrate.TofCalibrationRequest, "service.calibrate.tof:calibrate_tof", _tof)
    product_command(kinds, "rig", RigCalibrationRequest, "service.calibrate.rig_lamps:calibrate_rig", _rig)
    app.add_typer(kinds)


def _saturation(result: Any) -> None:
    print(f"level    {result.level:g}")
    print("readings " + ", ".join(f"{count} {name}" for count, name in zip(result.counts, ("red", "green", "blue"), strict=True)))
    if result.manifest_path is not None and result.report_path is not None:
        _print_files((result.manifest_path,), result.report_path)


def _white_balance(result: Any) -> None:
    _print_files((result.manifest_path,), result.report_path)
    print("gains    " + ", ".join(f"{gain:.4f} {name}" for gain, name in zip(result.gains, ("red", "green", "blue"), strict=True)))
    for row in result.matrix:
        print("matrix   " + " ".join(f"{value:9.5f}" for value in row))


def _chart(result: Any) -> None:
    _print_files((result.manifest_path,), result.report_path)
    print(f"picture  {result.picture_path}")
    for kind in result.kinds:
        print(f"colours  {kind.summary}")
        for row in kind.colors.matrix:
            print("matrix   " + " ".join(f"{value:9.5f}" for value in row))
        print_table([("patch", "before", "after", "remark"), *kind.rows[:LIGHT_ROWS]])


def _procam(result: Any) -> None:
    _print_files(result.manifest_paths, result.report_path)
    print(f"error    {result.rms_px:.3f} px RMS, baseline {result.baseline_m:.4f} m, depths known to {100 * result.certainty.depth:.2g} %")
    print_table([("view", "camera, px", "projector, px", "remark"), *result.rows[:VIEW_ROWS]])


def _stereo(result: Any) -> None:
    _print_files(result.manifest_paths, result.report_path)
    print(f"error    {result.summary}")
    print_table([("frame", "other camera", "camera, px", "other, px", "remark"), *result.rows[:VIEW_ROWS]])


def _laser_planes(result: Any, request: calibrate.LaserPlanesRequest) -> None:
    _print_files(result.manifest_paths, result.report_path)
    print_table([("frame", "tilt sure to", "residual", "from" if request.step_m is None else "sure to"), *result.rows[:LIGHT_ROWS]])


def _response(result: Any) -> None:
    _print_files((result.manifest_path,), result.report_path)
    print(f"response nearest to level^{result.gamma:.2f}; pixels deviate by {100 * result.spread:.2g} % of full scale")


def _tof(result: Any) -> None:
    print_lines(file=result.path, report=result.report_path)
    drift = result.calibration.temperature
    found = [f"wiggling at {harmonics.modulation_hz / 1e6:g} MHz" for harmonics in result.calibration.harmonics]
    found += [f"scale {result.calibration.scale:.5g}", f"offset {1000 * result.calibration.offset_m:.2f} mm"]
    found += [] if drift is None else [f"drift {1000 * drift.metres_per_c:.3f} mm a degree"]
    print(f"found    {', '.join(found)}")
    print(f"error    {1000 * result.before_m:.2f} mm before, {1000 * result.after_m:.2f} mm after, RMS over {result.steps} steps")
    if result.calibration.sigma_m is not None:
        print(f"sure to  {1000 * result.calibration.sigma_m:.2f} mm")


def _rig(result: Any) -> None:
    print_lines(rig=result.rig_path, report=result.report_path, lamps=result.summary)
    _print_least_sure(result)


def _print_files(manifest_paths: Iterable[Path], report_path: Path) -> None:
    for path in manifest_paths:
        print(f"capture  {path}")
    print(f"report   {report_path}")


def _print_lights(result: "LightCalibration") -> None:
    """Print where the results are, and the lights that are least sure."""
    _print_files((result.manifest_path,), result.report_path)
    print(f"lights   {result.summary}")
    _print_least_sure(result)


def _print_least_sure(result: Any) -> None:
    print_table([result.headings, *result.rows[:LIGHT_ROWS]])
    if len(result.rows) > LIGHT_ROWS:
        print(f"… and {len(result.rows) - LIGHT_ROWS} that are surer")


def _print_image(name: str, result: "ImageCalibration") -> None:
    print(f"{name:<8} {result.image_path}")
    _print_files((result.manifest_path,), result.report_path)
