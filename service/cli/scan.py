"""relit scan: shots of a scanning laser as one point cloud."""

from pathlib import Path
from typing import Annotated

import typer

from service.cli.options import DeviceOption


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("scan")(scan)


def scan(
    folder: Annotated[Path, typer.Argument(metavar="SCAN", help="A folder with a scan.json, or the file.", show_default=False)],
    out: Annotated[Path, typer.Option("--out", help="Folder for points.ply, points.usdc and report.json.", show_default=False)],
    near_m: Annotated[float | None, typer.Option("--near-m", help="Nearer returns, in metres, are left out.", show_default=False)] = None,
    far_m: Annotated[float | None, typer.Option("--far-m", help="Farther returns, in metres, are left out.", show_default=False)] = None,
    las: Annotated[bool, typer.Option("--las", help="Write points.las (LAS 1.4) too; needs laspy: pip install 'relit[las]'.")] = False,
    device: DeviceOption = None,
) -> None:
    """Shots of a scanning laser, from a platform that may move, as one point cloud."""
    from service.cli.bar import Bar
    from service.depth.scan import scan as run
    from service.requests.scan import ScanRequest

    with Bar() as bar:
        result = run(ScanRequest(scan=folder, out=out, near_m=near_m, far_m=far_m, las=las, device=device), bar)
    print(f"points   {result.points_path}")
    print(f"usd      {result.usd_path}")
    if result.las_path is not None:
        print(f"las      {result.las_path}")
    print(f"report   {result.report_path}")
    print(f"shots    {', '.join(f'{count} {name}' for name, count in result.counts.items() if count)}")
