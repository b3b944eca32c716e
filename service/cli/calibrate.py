"""relit calibrate KIND: lights, dark, flat and saturation from images."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from service.cli import calibrate_projector, calibrate_tof
from service.cli.options import CaptureArgument, HostOption

if TYPE_CHECKING:
    from service.calibrate.results import Calibration
    from service.requests.calibrate import Circle

TABLE_ROWS = 12
"""Lights that the table shows; the report holds all."""

BallOption = Annotated[list[str] | None, typer.Option(
    "--ball", metavar="U,V,R", help="Outline of a ball: centre and radius in pixels.", show_default=False)]
BallMaskOption = Annotated[list[Path] | None, typer.Option(
    "--ball-mask", help="Mask image of a ball, in place of --ball; better for a perspective camera.", show_default=False)]
ApplyOption = Annotated[Path | None, typer.Option(
    "--apply-to", metavar="CAPTURE", help="Write another capture's manifest: same lights, same order.", show_default=False)]
OutOption = Annotated[Path | None, typer.Option(
    "--out", help="Manifest to write, in place of the capture's own.", show_default=False)]
DropOption = Annotated[bool, typer.Option("--drop-failed", help="Leave out frames whose light cannot be measured.")]
LevelOption = Annotated[float, typer.Option("--level", help="The spot is brighter than this part of its peak.")]
ImagesArgument = Annotated[list[Path], typer.Argument(metavar="IMAGE...", help="Images to average.", show_default=False)]


def register(app: typer.Typer) -> None:
    """Add the command and its kinds."""
    kinds = typer.Typer(name="calibrate", no_args_is_help=True,
                        help="Lights, projector and camera, dark frame, flat field and saturation from images; with residuals.")
    for name, command in (("mirror-ball", mirror_ball), ("light-positions", light_positions), ("grey-ball", grey_ball),
                          ("intensity", intensity), ("dark", dark), ("flat-field", flat_field), ("saturation", saturation)):
        kinds.command(name)(command)
    calibrate_projector.register(kinds)
    calibrate_tof.register(kinds)
    app.add_typer(kinds)


def mirror_ball(
    capture: CaptureArgument,
    ball: BallOption = None,
    ball_mask: BallMaskOption = None,
    level: LevelOption = 0.1,
    drop_failed: DropOption = False,
    apply_to: ApplyOption = None,
    out: OutOption = None,
    device: HostOption = None,
) -> None:
    """Directions of far lights from one mirror ball."""
    from service.calibrate.lights import mirror_ball as run
    from service.cli.bar import Bar
    from service.requests.calibrate import MirrorBallRequest

    request = MirrorBallRequest(capture=capture, circles=_circles(ball), masks=tuple(ball_mask or ()), level=level,
                                drop_failed=drop_failed, apply_to=apply_to, out=out)
    with Bar() as bar:
        result = run(request, bar)
    _show(result)


def light_positions(
    capture: CaptureArgument,
    ball: BallOption = None,
    ball_mask: BallMaskOption = None,
    ball_radius_m: Annotated[list[float] | None, typer.Option(
        "--ball-radius-m", help="Of every ball, or once a ball.", show_default=False)] = None,
    ball_z_m: Annotated[list[float] | None, typer.Option(
        "--ball-z-m", help="Camera-frame z of the centres, for an orthographic camera; without it surface_z_m.",
        show_default=False)] = None,
    level: LevelOption = 0.1,
    drop_failed: DropOption = False,
    apply_to: ApplyOption = None,
    out: OutOption = None,
    device: HostOption = None,
) -> None:
    """Positions of near lights from two or more mirror balls."""
    from service.calibrate.lights import light_positions as run
    from service.cli.bar import Bar
    from service.requests.calibrate import LightPositionsRequest

    request = LightPositionsRequest(capture=capture, circles=_circles(ball), masks=tuple(ball_mask or ()),
                                    ball_radius_m=tuple(ball_radius_m or ()), ball_z_m=tuple(ball_z_m or ()), level=level,
                                    drop_failed=drop_failed, apply_to=apply_to, out=out)
    with Bar() as bar:
        result = run(request, bar)
    _show(result)


def grey_ball(
    capture: CaptureArgument,
    ball: BallOption = None,
    ball_mask: BallMaskOption = None,
    albedo: Annotated[str | None, typer.Option(
        "--albedo", metavar="R,G,B", help="Of the ball, one number or three; without it the mean irradiance is 1.",
        show_default=False)] = None,
    refine_direction: Annotated[bool, typer.Option(
        "--refine-direction", help="Take the direction of distant lights from the shading too.")] = False,
    ball_radius_m: Annotated[float | None, typer.Option(
        "--ball-radius-m", help="For point lights and a perspective camera.", show_default=False)] = None,
    ball_z_m: Annotated[float | None, typer.Option(
        "--ball-z-m", help="For point lights and an orthographic camera; without it surface_z_m.", show_default=False)] = None,
    drop_failed: DropOption = False,
    apply_to: ApplyOption = None,
    out: OutOption = None,
    device: HostOption = None,
) -> None:
    """Brightness of each light from one grey ball."""
    from service.calibrate.lights import grey_ball as run
    from service.cli.bar import Bar
    from service.requests.calibrate import GreyBallRequest

    request = GreyBallRequest(capture=capture, circles=_circles(ball), masks=tuple(ball_mask or ()), albedo=_albedo(albedo),
                              refine_direction=refine_direction, ball_radius_m=ball_radius_m, ball_z_m=ball_z_m,
                              drop_failed=drop_failed, apply_to=apply_to, out=out)
    with Bar() as bar:
        result = run(request, bar)
    _show(result)


def intensity(
    capture: CaptureArgument,
    pixels: Annotated[int, typer.Option("--pixels", help="Of the mask, drawn at random, that take part.")] = 2000,
    drop_failed: DropOption = False,
    apply_to: ApplyOption = None,
    out: OutOption = None,
    device: HostOption = None,
) -> None:
    """Brightness of lights of known direction from images of the object itself."""
    from service.calibrate.object import intensity as run
    from service.cli.bar import Bar
    from service.requests.calibrate import IntensityRequest

    request = IntensityRequest(capture=capture, pixels=pixels, drop_failed=drop_failed, apply_to=apply_to, out=out)
    with Bar() as bar:
        result = run(request, bar)
    _show(result)


def dark(capture: CaptureArgument, images: ImagesArgument, device: HostOption = None) -> None:
    """The capture's dark.exr: mean of images with the lens covered."""
    from service.calibrate.images import dark as run
    from service.cli.bar import Bar
    from service.requests.calibrate import DarkRequest

    with Bar() as bar:
        result = run(DarkRequest(capture=capture, images=tuple(images)), bar)
    print(f"dark     {result.image_path}")
    print(f"capture  {result.manifest_path}")
    print(f"report   {result.report_path}")


def flat_field(
    capture: CaptureArgument,
    images: ImagesArgument,
    dark: Annotated[list[Path] | None, typer.Option(
        "--dark", help="A dark image at the card's exposure; may be repeated. Without it the capture's dark.",
        show_default=False)] = None,
    device: HostOption = None,
) -> None:
    """The capture's flat.exr: mean of images of an evenly lit white card."""
    from service.calibrate.images import flat_field as run
    from service.cli.bar import Bar
    from service.requests.calibrate import FlatFieldRequest

    with Bar() as bar:
        result = run(FlatFieldRequest(capture=capture, images=tuple(images), dark_images=tuple(dark or ())), bar)
    print(f"flat     {result.image_path}")
    print(f"capture  {result.manifest_path}")
    print(f"report   {result.report_path}")


def saturation(
    capture: CaptureArgument,
    write: Annotated[bool, typer.Option("--write", help="Set it in the manifest.")] = False,
    device: HostOption = None,
) -> None:
    """Where the readings of the frames pile up at the top of the histogram."""
    from service.calibrate.images import saturation as run
    from service.cli.bar import Bar
    from service.requests.calibrate import SaturationRequest

    with Bar() as bar:
        result = run(SaturationRequest(capture=capture, write=write), bar)
    print(f"level    {result.level:g}")
    print("readings " + ", ".join(f"{count} {name}" for count, name in zip(result.counts, ("red", "green", "blue"), strict=True)))
    if result.manifest_path is not None:
        print(f"capture  {result.manifest_path}")
        print(f"report   {result.report_path}")


def _circles(texts: list[str] | None) -> "tuple[Circle, ...]":
    from service.requests.calibrate import Circle

    circles = []
    for text in texts or ():
        u, v, radius = _numbers("--ball", text, (3,), "centre and radius in pixels, such as 812.5,604,230")
        circles.append(Circle(u=u, v=v, radius_px=radius))
    return tuple(circles)


def _albedo(text: str | None) -> tuple[float, float, float] | None:
    if text is None:
        return None
    values = _numbers("--albedo", text, (1, 3), "one number or three, such as 0.18")
    red, green, blue = values * 3 if len(values) == 1 else values
    return red, green, blue


def _numbers(option: str, text: str, counts: tuple[int, ...], what: str) -> list[float]:
    from service.errors import RequestError

    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) not in counts or not all(abs(value) < float("inf") for value in values):
        raise RequestError(f"{option} {text}: give {what}")
    return values


def _show(result: "Calibration") -> None:
    """Where things are, and the lights that are least sure."""
    print(f"capture  {result.manifest_path}")
    print(f"report   {result.report_path}")
    print(f"lights   {result.summary}")
    rows = [result.headings, *result.rows[:TABLE_ROWS]]
    widths = [max(len(row[column]) for row in rows) for column in range(len(result.headings))]
    for row in rows:
        print("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip())
    if len(result.rows) > TABLE_ROWS:
        print(f"… and {len(result.rows) - TABLE_ROWS} that are surer")
