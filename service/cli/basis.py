"""relit basis: a capture reduced to a few images."""

from pathlib import Path
from typing import Annotated

import typer

from service.cli.options import AlignOption, AlignToOption, CacheOption, CaptureArgument, DeviceOption
from service.requests.basis import BasisKind


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("basis")(basis)


def basis(
    capture: CaptureArgument,
    out: Annotated[Path, typer.Option("--out", help="The file: .exr, .ptm or .rti; a .json with its facts lies beside it.",
                                      show_default=False)],
    kind: Annotated[BasisKind | None, typer.Option(
        "--kind", show_default=False,
        help="svd: the images that lose least (.exr); ptm: polynomial texture map, lrgb-ptm: of the luminance (.ptm); "
             "hsh: hemispherical harmonics (.rti). Without it what the suffix says.")] = None,
    count: Annotated[int | None, typer.Option(
        "--count", min=1, show_default=False,
        help="Coefficients: of svd up to the number of lights, 16 without it; of hsh 4, 9 or 16.")] = None,
    align: AlignOption = False,
    align_to: AlignToOption = None,
    device: DeviceOption = None,
    cache: CacheOption = None,
) -> None:
    """A capture as a few coefficient images, for a browser or for RTI viewers."""
    from service.basis.basis import make_basis
    from service.cli.bar import Bar
    from service.requests.basis import BasisRequest

    with Bar() as bar:
        result = make_basis(BasisRequest(capture=capture, out=out, kind=kind, count=count, align=align, align_to=align_to,
                                         device=device, cache=cache), bar)
    print(f"basis    {result.path}")
    print(f"facts    {result.facts_path}")
    shown = "" if result.levels_rms is None else f" of what is shown, {result.levels_rms:.1f} of 255"
    print(f"error    {100 * result.relative_rms:.3g} % RMS{shown}: {result.terms} coefficients a channel, {result.lights} lights, "
          f"{result.pixels} pixels")
    if result.left_out:
        print(f"lights   {result.left_out} are not in front of the object and are left out")
    if result.near_lights:
        print(f"lights   {result.near_lights} near lights are taken as distant, as the object's centre sees them")
