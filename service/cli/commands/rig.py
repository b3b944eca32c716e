"""relit rig, drive, play and twin: rig files, the levels of their lamps that reproduce an environment, and what sends and shows these."""

from typing import Any

import typer

from service.cli.groups import make_group
from service.cli.printing import print_lines, print_warnings
from service.cli.progress import with_bar
from service.cli.request_commands import local_command, product_command
from service.requests import rig as requests
from service.requests.drive import DriveRequest
from service.requests.play import PlayRequest, TwinRequest


def register(app: typer.Typer) -> None:
    """Add the commands."""
    rig = make_group("rig", help="Rigs of driven lamps: check them, make them from captures, tables and scenes, plan them; docs/drive.md.")
    local_command(rig, "check", _check)
    product_command(rig, "from-capture", requests.RigFromCaptureRequest, "service.rigs.from_capture:rig_from_capture", _made)
    product_command(rig, "from-csv", requests.RigFromCsvRequest, "service.rigs.from_capture:rig_from_csv", _made)
    product_command(rig, "from-mvr", requests.RigFromMvrRequest, "service.rigs.from_mvr:rig_from_mvr",
                    lambda made, request: _made(made.rig, request))
    product_command(rig, "sweep", requests.RigSweepRequest, "service.rigs.sweep:sweep_rig", _sweep)
    product_command(rig, "plan", requests.RigPlanRequest, "service.rigs.dome_plan:plan_rig", _plan)
    app.add_typer(rig)
    product_command(app, "drive", DriveRequest, "service.drive.drive:drive", _drive)
    local_command(app, "play", _play)
    local_command(app, "twin", _twin)


def _drive(result: Any) -> None:
    print_lines(cues=result.cues, picture=result.picture, report=result.report, exposure=f"{result.exposure:.4g}")
    print(f"error    irradiance {100 * result.judgement.rms.max():.2g} % RMS, chromaticity {result.judgement.chromaticity.max():.2g} u'v', "
          f"the largest of {result.frames} frames")


def _check(request: requests.RigCheckRequest) -> None:
    from service.errors import RequestError
    from service.rigs.check import check_rig

    found = check_rig(request)
    print(f"rig      {found.rig.name}: {len(found.rig.lights)} lamps, {found.rig.color_space}")
    print(f"lamps    {', '.join(f'{count} with {name}' for name, count in found.primaries.items())}")
    for universe, channels in found.universes.items():
        print(f"universe {universe.protocol} {universe.number}: {channels} channels" + (f", to {universe.host}" if universe.host else ""))
    print_lines(picture=request.picture)
    print_warnings(found.warnings)
    if found.faults:
        raise RequestError("; ".join(f"{request.rig}: {fault}" for fault in found.faults))


def _made(rig: Any, request: requests.RigFromCaptureRequest | requests.RigFromCsvRequest | requests.RigFromMvrRequest) -> None:
    print(f"rig      {request.out}: {len(rig.lights)} lamps")


def _sweep(made: Any) -> None:
    print(f"cues     {made.cues}: {made.frames} frames, the first is dark")
    print(f"table    {made.table}")


def _plan(found: Any, request: requests.RigPlanRequest) -> None:
    print_lines(table=request.out / "plan.csv", plot=request.out / "plan.png")
    rows, doubts = found
    for row in rows:
        highlights = ", ".join(f"{100 * error:.{1 if error < 0.1 else 0}f}" for error in row.highlights)
        of = f" of {row.rig}" if row.rig else ""
        print(f"{row.lights:>6} lamps{of} under {row.environment}: irradiance {100 * row.irradiance:.2g} %, highlights {highlights} %")
    print_warnings(doubts)


def _play(request: PlayRequest) -> None:
    from service.play.play import LATE_S, play

    result = play(request)
    print(f"frames   {result.frames} sent; the lamps are dark")
    late = "none" if not result.late else f"{result.late} by more than {1e3 * LATE_S:g} ms, the latest by {1e3 * result.latest_s:.3g} ms"
    print(f"late     {late}")
    if result.interrupted and not request.loop and request.hold is None:
        print("ended    before the last frame")
        raise typer.Exit(1)


def _twin(request: TwinRequest) -> None:
    from service.twin.twin import open_twin, rehearse

    twin = with_bar(open_twin, request)
    print_warnings(twin.picture.warnings)
    result = rehearse(twin, request, lambda page: _listening(request.interface, page))
    print(f"frames   {result.frames} received")
    if result.out_of_order:
        print(f"packets  {result.out_of_order} came out of order and were left out")
    print_lines(picture=request.snapshot, levels=request.record)


def _listening(interface: str, page: str | None) -> None:
    print(f"twin     listens on {interface} for sACN and Art-Net", flush=True)
    if page is not None:
        print(f"page     {page}: until Ctrl-C", flush=True)
