"""relit relight and relit shade: pictures of captures and of solved maps under new light."""

import typer

from service.cli.printing import print_warnings
from service.cli.progress import ProgressOption, ProgressStyle, progress_in
from service.cli.request_commands import local_command
from service.requests.relight import RelightRequest
from service.requests.shade import ShadeRequest


def register(app: typer.Typer) -> None:
    """Add the commands."""
    local_command(app, "relight", _relight)
    local_command(app, "shade", _shade)


def _relight(request: RelightRequest, progress: ProgressOption = ProgressStyle.BAR) -> None:
    from service.relight.relight import relight

    with progress_in(progress) as bar:
        result = relight(request, bar)
    last = f" … {result.frames[-1].name}" if len(result.frames) > 1 else ""
    print(f"frames   {result.frames[0]}{last}")
    if result.captures > 1:
        print(f"captures {result.captures}, one a frame")
    if result.skipped:
        rest = "; the others are made" if result.skipped < len(result.frames) else ""
        print(f"skipped  {result.skipped} of {len(result.frames)} frames were there already, made by an equal run{rest}")
    if request.display is not None:
        print(f"display  {request.display}")
    if request.sheet is not None:
        print(f"sheet    {request.sheet}")
    if request.nuke is not None:
        print(f"nuke     {request.nuke}")
    if request.report is not None:
        print(f"report   {request.report}")
    if result.near_lights:
        print(f"lights   {result.near_lights} near lights are taken as distant, as the object's centre sees them")
    if result.matte:
        print(f"matte    {result.matte}")
    if result.clipped:
        print(f"clipped  {result.clipped} pixels are brighter than half can hold and stand at its largest value")
    print_warnings(result.warnings)


def _shade(request: ShadeRequest, progress: ProgressOption = ProgressStyle.BAR) -> None:
    from service.relight.shade import shade

    with progress_in(progress) as bar:
        result = shade(request, bar)
    print(f"picture  {result.path}")
    if request.display is not None:
        print(f"display  {request.display}")
    if not result.metric:
        print("scale    the maps have none: places of lights are taken in pixels")
    if result.clipped:
        print(f"clipped  {result.clipped} pixels are brighter than half can hold and stand at its largest value")
    print_warnings(result.warnings)
