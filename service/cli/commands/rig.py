"""relit rig and relit drive: rig files, and the levels of their lamps that reproduce an environment."""

import typer

from service.cli.groups import make_group
from service.cli.printing import print_warnings
from service.cli.progress import with_bar
from service.cli.request_commands import local_command
from service.requests.drive import DriveRequest
from service.requests.rig import (
    RigCheckRequest,
    RigFromCaptureRequest,
    RigFromCsvRequest,
    RigFromMvrRequest,
    RigPlanRequest,
    RigSweepRequest,
)


def register(app: typer.Typer) -> None:
    """Add the commands."""
    rig = make_group("rig", help="Rigs of driven lamps: check them, make them from captures, tables and scenes, plan them; docs/drive.md.")
    local_command(rig, "check", _check)
    local_command(rig, "from-capture", _from_capture)
    local_command(rig, "from-csv", _from_csv)
    local_command(rig, "from-mvr", _from_mvr)
    local_command(rig, "sweep", _sweep)
    local_command(rig, "plan", _plan)
    app.add_typer(rig)
    local_command(app, "drive", _drive)


def _drive(request: DriveRequest) -> None:
    from service.drive.drive import drive

    result = with_bar(drive, request)
    print(f"cues     {result.cues}")
    print(f"picture  {result.picture}")
    print(f"report   {result.report}")
    print(f"exposure {result.exposure:.4g}")
    print(f"error    irradiance {100 * result.judgement.rms.max():.2g} % RMS, chromaticity {result.judgement.chromaticity.max():.2g} u'v', "
          f"the largest of {result.frames} frames")
    print_warnings(result.warnings)


def _check(request: RigCheckRequest) -> None:
    from service.errors import RequestError
    from service.rigs.check import check_rig

    found = check_rig(request)
    print(f"rig      {found.rig.name}: {len(found.rig.lights)} lamps, {found.rig.color_space}")
    print(f"lamps    {', '.join(f'{count} with {name}' for name, count in found.primaries.items())}")
    for universe, channels in found.universes.items():
        print(f"universe {universe.protocol} {universe.number}: {channels} channels" + (f", to {universe.host}" if universe.host else ""))
    if request.picture is not None:
        print(f"picture  {request.picture}")
    print_warnings(found.warnings)
    if found.faults:
        raise RequestError("; ".join(f"{request.rig}: {fault}" for fault in found.faults))


def _from_capture(request: RigFromCaptureRequest) -> None:
    from service.rigs.from_capture import rig_from_capture

    rig = rig_from_capture(request)
    print(f"rig      {request.out}: {len(rig.lights)} lamps")


def _from_csv(request: RigFromCsvRequest) -> None:
    from service.rigs.from_capture import rig_from_csv

    rig = rig_from_csv(request)
    print(f"rig      {request.out}: {len(rig.lights)} lamps")


def _from_mvr(request: RigFromMvrRequest) -> None:
    from service.rigs.from_mvr import rig_from_mvr

    made = rig_from_mvr(request)
    print(f"rig      {request.out}: {len(made.rig.lights)} lamps")
    print_warnings(made.warnings)


def _sweep(request: RigSweepRequest) -> None:
    from service.rigs.sweep import sweep_rig

    made = sweep_rig(request)
    print(f"cues     {made.cues}: {made.frames} frames, the first is dark")
    print(f"table    {made.table}")


def _plan(request: RigPlanRequest) -> None:
    from service.rigs.dome_plan import plan_rig

    rows = with_bar(plan_rig, request)
    print(f"table    {request.out / 'plan.csv'}")
    print(f"plot     {request.out / 'plan.png'}")
    for row in rows:
        highlights = ", ".join(f"{100 * error:.2g}" for error in row.highlights)
        of = f" of {row.rig}" if row.rig else ""
        print(f"{row.lights:>6} lamps{of} under {row.environment}: irradiance {100 * row.irradiance:.2g} %, highlights {highlights} %")
