"""relit relight: frames of a capture, or of a sequence of captures, under new light."""

from pathlib import Path
from typing import Annotated

import typer

from service.cli.bar import ProgressStyle, show
from service.cli.options import AlignOption, AlignToOption, CacheOption, DeviceOption, ProgressOption
from service.requests.picture import FrameCompression, FrameSpace
from service.requests.relight import LightWeights


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("relight")(relight)


def relight(
    capture: Annotated[Path, typer.Argument(
        metavar="CAPTURE", show_default=False,
        help="Folder with a capture.json; or with one such folder a time step, in order of name: each gives one frame.")],
    out: Annotated[str, typer.Option("--out", help="Path of the frames, #### for the number.", show_default=False)],
    environment: Annotated[Path | None, typer.Option(
        "--environment", help="Lat-long .exr or .hdr; with #### in its name one a frame.", show_default=False)] = None,
    keys: Annotated[Path | None, typer.Option(
        "--keys", metavar="FILE", show_default=False,
        help="Light keys (JSON): animated lights, environment, captured images and exposure; docs/relight.md.")] = None,
    frames: Annotated[str | None, typer.Option(
        "--frames", show_default=False, help="A number, or first-last; without it 1, or one for each time step.")] = None,
    only: Annotated[str | None, typer.Option(
        "--only", metavar="FRAMES", show_default=False,
        help="Make this part of --frames alone, such as 9-16: what a farm gives to one machine.")] = None,
    spin_degrees: Annotated[float, typer.Option(
        "--spin-degrees", help="Turn of the environment about +y over the range, +z towards +x; frame one is unturned.")] = 0.0,
    weights: Annotated[LightWeights | None, typer.Option(
        "--weights", show_default=False,
        help="cells: light goes whole to the nearest captured light; smooth: to the three around it. "
             "Without it cells, with --maps smooth.")] = None,
    exposure: Annotated[float, typer.Option("--exposure", metavar="STOPS", help="Frames are multiplied by 2 to this power.")] = 0.0,
    aov: Annotated[str, typer.Option(
        "--aov", metavar="LAYERS",
        help="Layers of each frame, with commas: beauty, mask; with --maps diffuse, specular, normal, confidence.")] = "beauty",
    maps: Annotated[Path | None, typer.Option(
        "--maps", metavar="DIR", show_default=False,
        help="Folder of the solved maps: what lies between the captured lights is taken from a model of them, as far as it "
             "proves right. For a sequence with one folder a capture in it.")] = None,
    color_space: Annotated[FrameSpace | None, typer.Option(
        "--color-space", show_default=False,
        help="Of the frames: lin_ap1_scene is ACEScg; without it the capture's own scene-linear space.")] = None,
    compression: Annotated[FrameCompression, typer.Option(
        "--compression", help="zip and piz keep every bit; dwaa is lossy and smaller.")] = FrameCompression.ZIP,
    overwrite: Annotated[bool, typer.Option(
        "--overwrite", help="Make every frame; without it those that an equal run has made already are kept.")] = False,
    sheet: Annotated[Path | None, typer.Option(
        "--sheet", metavar="FILE.png", help="Contact sheet of the frames, for review.", show_default=False)] = None,
    report: Annotated[Path | None, typer.Option(
        "--report", metavar="FILE.json", help="What was made, and where the time went.", show_default=False)] = None,
    align: AlignOption = False,
    align_to: AlignToOption = None,
    device: DeviceOption = None,
    cache: CacheOption = None,
    progress: ProgressOption = ProgressStyle.BAR,
) -> None:
    """Frames under HDR environments and animated lights."""
    from service.light.relight import relight as run
    from service.requests.relight import RelightRequest

    request = RelightRequest.model_validate({
        "capture": capture, "out": out, "environment": environment, "keys": keys, "frames": frames, "only": only,
        "spin_degrees": spin_degrees, "weights": weights, "exposure": exposure, "aov": aov, "maps": maps, "color_space": color_space,
        "compression": compression, "overwrite": overwrite, "sheet": sheet, "report": report, "align": align, "align_to": align_to,
        "device": device, "cache": cache})
    with show(progress) as bar:
        result = run(request, bar)
    last = f" … {result.frames[-1].name}" if len(result.frames) > 1 else ""
    print(f"frames   {result.frames[0]}{last}")
    if result.captures > 1:
        print(f"captures {result.captures}, one a frame")
    if result.skipped:
        rest = "; the others are made" if result.skipped < len(result.frames) else ""
        print(f"skipped  {result.skipped} of {len(result.frames)} frames were there already, made by an equal run{rest}")
    if sheet is not None:
        print(f"sheet    {sheet}")
    if report is not None:
        print(f"report   {report}")
    if result.near_lights:
        print(f"lights   {result.near_lights} near lights are taken as distant, as the object's centre sees them")
    if result.clipped:
        print(f"clipped  {result.clipped} pixels are brighter than half can hold and stand at its largest value")
