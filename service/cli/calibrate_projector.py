"""relit calibrate procam, relit calibrate response: the kinds that are about the projector."""

from pathlib import Path
from typing import Annotated

import typer

from service.cli.options import CacheOption, CaptureArgument, DeviceOption, HostOption

MAX_ROWS = 40
"""Views that the table shows; the report holds all."""


def register(kinds: typer.Typer) -> None:
    """Add the kinds."""
    kinds.command("procam")(procam)
    kinds.command("response")(response)


def procam(
    captures: Annotated[list[Path], typer.Argument(metavar="CAPTURE...", help="Folders, one a pose of the board.", show_default=False)],
    board: Annotated[str, typer.Option("--board", metavar="9x6", help="Inner corners of the chessboard, across and down.",
                                       show_default=False)],
    square_m: Annotated[float, typer.Option("--square-m", help="Side of a square, metres.", show_default=False)],
    projector: Annotated[str | None, typer.Option(
        "--projector", metavar="1280x800", help="Pixels of the projector; without it what the captures say.", show_default=False)] = None,
    apply_to: Annotated[list[Path] | None, typer.Option(
        "--apply-to", metavar="CAPTURE", help="Write this capture's manifest too; may be repeated.", show_default=False)] = None,
    drop_outliers: Annotated[bool, typer.Option("--drop-outliers", help="Leave out views whose error stands out.")] = False,
    device: DeviceOption = None,
    cache: CacheOption = None,
) -> None:
    """Camera, projector and their pose from a chessboard under projected columns and rows."""
    from service.calibrate.procam import procam as run
    from service.cli.bar import Bar
    from service.requests.calibrate import ProcamRequest

    request = ProcamRequest(captures=tuple(captures), board=size("--board", board), square_m=square_m,
                            projector=None if projector is None else size("--projector", projector), apply_to=tuple(apply_to or ()),
                            drop_outliers=drop_outliers, device=device, cache=cache)
    with Bar() as bar:
        result = run(request, bar)
    for path in result.manifest_paths:
        print(f"capture  {path}")
    print(f"report   {result.report_path}")
    print(f"error    {result.rms_px:.3f} px RMS, baseline {result.baseline_m:.4f} m")
    rows = [("view", "camera, px", "projector, px", "remark"), *result.rows[:MAX_ROWS]]
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    for row in rows:
        print("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip())


def response(
    capture: CaptureArgument,
    images: Annotated[list[Path], typer.Argument(metavar="IMAGE...", help="Images of evenly grey projections.", show_default=False)],
    levels: Annotated[str | None, typer.Option(
        "--levels", metavar="0,0.25,…", help="Of each image; without it even steps from 0 to 1.", show_default=False)] = None,
    device: HostOption = None,
) -> None:
    """The projector's light at each level (its gamma), for ramps."""
    from service.calibrate.response import response as run
    from service.cli.bar import Bar
    from service.errors import RequestError
    from service.requests.calibrate import ResponseRequest

    try:
        given = tuple(float(part) for part in levels.split(",")) if levels is not None else ()
    except ValueError:
        raise RequestError(f"--levels {levels}: give numbers from 0 to 1 with commas between") from None
    with Bar() as bar:
        result = run(ResponseRequest(capture=capture, images=tuple(images), levels=given), bar)
    print(f"capture  {result.manifest_path}")
    print(f"report   {result.report_path}")
    print(f"response nearest to level^{result.gamma:.2f}; pixels deviate by {100 * result.spread:.2g} % of full scale")


def size(option: str, text: str) -> tuple[int, int]:
    """Two whole numbers as WIDTHxHEIGHT.

    Raises:
        RequestError: something else.
    """
    from service.errors import RequestError

    parts = text.lower().split("x")
    if len(parts) != 2 or not all(part.isdecimal() and int(part) > 0 for part in parts):
        raise RequestError(f"{option} {text}: give two whole numbers with an x between, as 9x6")
    return int(parts[0]), int(parts[1])
