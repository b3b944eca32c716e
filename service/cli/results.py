"""relit solve, relit export: results out."""

from pathlib import Path
from typing import Annotated

import typer

from service.cli.options import AlignOption, AlignToOption, CacheOption, CaptureArgument, DeviceOption, HostOption
from service.requests.export import Geometry
from service.requests.solve import Method


def register(app: typer.Typer) -> None:
    """Add the commands."""
    app.command("solve")(solve)
    app.command("export")(export)


def solve(
    capture: CaptureArgument,
    out: Annotated[Path, typer.Option("--out", help="Folder for maps.exr and report.json.", show_default=False)],
    method: Annotated[Method | None, typer.Option(
        "--method", show_default=False,
        help="lambert: least squares on every light; robust: without shadows and highlights; "
             "svbrdf: with specular and roughness; gradient: from spherical gradient frames; "
             "reference: from a ball of the same material. "
             "Without it what the capture's frames allow.")] = None,
    reference_ball: Annotated[Path | None, typer.Option(
        "--reference-ball", metavar="CAPTURE", show_default=False,
        help="A ball of the object's material under the same lights, for --method reference.")] = None,
    align: AlignOption = False,
    align_to: AlignToOption = None,
    device: DeviceOption = None,
    cache: CacheOption = None,
) -> None:
    """Normals, albedo and height of a light-stage capture."""
    from service.cli.bar import Bar
    from service.requests.solve import SolveRequest
    from service.solve.solve import solve as run

    with Bar() as bar:
        result = run(SolveRequest(capture=capture, out=out, method=method, reference_ball=reference_ball, align=align,
                                  align_to=align_to, device=device, cache=cache), bar)
    print(f"maps     {result.maps_path}")
    print(f"report   {result.report_path}")
    print(f"pixels   {', '.join(f'{count} {name}' for name, count in result.counts.items() if count)}")
    if result.suspects:
        worst = ", ".join(f"{suspect.image} by {100 * suspect.misfit:.0f} %" for suspect in result.suspects[:5])
        more = f" and {len(result.suspects) - 5} more" if len(result.suspects) > 5 else ""
        print(f"suspect  lights that disagree with the others: {worst}{more}; check their direction and irradiance")


def export(
    maps: Annotated[Path, typer.Argument(metavar="DIR", help="Folder with maps.exr or depth.exr.", show_default=False)],
    out: Annotated[Path, typer.Option("--out", help="The asset: .usdz, .usda or .usdc.", show_default=False)],
    name: Annotated[str | None, typer.Option("--name", help="Of the asset; without it the capture's.",
                                             show_default=False)] = None,
    geometry: Annotated[Geometry | None, typer.Option(
        "--geometry", show_default=False, help="Of a depth: mesh (without it) or points.")] = None,
    device: HostOption = None,
) -> None:
    """A USD asset: solved maps with the estimated material, a depth with its colours."""
    from service.cli.bar import Bar
    from service.requests.export import ExportRequest
    from service.usd.export import export as run

    with Bar() as bar:
        print(f"asset    {run(ExportRequest(maps=maps, out=out, name=name, geometry=geometry), bar)}")
