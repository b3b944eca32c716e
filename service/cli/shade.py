"""relit shade: solved maps under near lights, area lights and an environment."""

from pathlib import Path
from typing import Annotated

import typer

from service.cli.bar import ProgressStyle, show
from service.cli.options import CacheOption, DeviceOption, ProgressOption
from service.requests.picture import FrameCompression, FrameSpace


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("shade")(shade)


def shade(
    maps: Annotated[Path, typer.Argument(metavar="DIR", help="Folder with maps.exr.", show_default=False)],
    out: Annotated[Path, typer.Option("--out", help="The picture: .exr.", show_default=False)],
    light: Annotated[list[str] | None, typer.Option(
        "--light", metavar="x,y,z,r,g,b[,ax,ay,az,mu]", show_default=False,
        help="A point light: place in metres, camera frame, and intensity; with a lobe its axis and exponent. Any number of them.")] = None,
    sphere: Annotated[list[str] | None, typer.Option(
        "--sphere", metavar="x,y,z,radius,r,g,b", help="A sphere light: centre, radius, radiance.", show_default=False)] = None,
    rectangle: Annotated[list[str] | None, typer.Option(
        "--rectangle", metavar="x,y,z,ux,uy,uz,vx,vy,vz,r,g,b", show_default=False,
        help="A rectangle light: centre, its two edges, radiance; it shines against u x v, as a USD RectLight does.")] = None,
    environment: Annotated[Path | None, typer.Option("--environment", help="Lat-long .exr or .hdr.", show_default=False)] = None,
    turn_degrees: Annotated[float, typer.Option("--turn-degrees", help="Of the environment about +y, +z towards +x.")] = 0.0,
    capture: Annotated[Path | None, typer.Option(
        "--capture", metavar="CAPTURE", show_default=False,
        help="The capture of these maps: its images bring what a model of the maps lacks, such as interreflection.")] = None,
    exposure: Annotated[float, typer.Option("--exposure", metavar="STOPS", help="The picture is multiplied by 2 to this power.")] = 0.0,
    aov: Annotated[str, typer.Option(
        "--aov", metavar="LAYERS", help="Layers, with commas: beauty, diffuse, specular, mask, normal, confidence.")] = "beauty",
    color_space: Annotated[FrameSpace | None, typer.Option(
        "--color-space", help="Of the picture: lin_ap1_scene is ACEScg; without it that of the maps.", show_default=False)] = None,
    compression: Annotated[FrameCompression, typer.Option(
        "--compression", help="zip and piz keep every bit; dwaa is lossy and smaller.")] = FrameCompression.ZIP,
    device: DeviceOption = None,
    cache: CacheOption = None,
    progress: ProgressOption = ProgressStyle.BAR,
) -> None:
    """A picture of solved maps under near lights, area lights and an environment, with cast shadows."""
    from service.light.shade import shade as run
    from service.requests.shade import ShadeRequest

    request = ShadeRequest.model_validate({
        "maps": maps, "out": out, "light": light or (), "sphere": sphere or (), "rectangle": rectangle or (),
        "environment": environment, "turn_degrees": turn_degrees, "capture": capture, "exposure": exposure, "aov": aov,
        "color_space": color_space, "compression": compression, "device": device, "cache": cache})
    with show(progress) as bar:
        result = run(request, bar)
    print(f"picture  {result.path}")
    if not result.metric:
        print("scale    the maps have none: places of lights are taken in pixels")
    if result.clipped:
        print(f"clipped  {result.clipped} pixels are brighter than half can hold and stand at its largest value")
