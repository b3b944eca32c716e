"""relit info, view, solve, relight and shade: look at a capture, here and in a browser, solve it, and light it and its maps."""

from typing import Any

import typer

from service.cli.printing import check_single, counted, print_lines, print_sequence, print_warnings
from service.cli.progress import ProgressOption, ProgressStyle, progress_in, with_bar
from service.cli.request_commands import local_command, product_command
from service.requests.captures import InfoRequest, ViewRequest
from service.requests.relight import RelightRequest
from service.requests.shade import ShadeRequest
from service.requests.solve import SolveRequest


def register(app: typer.Typer) -> None:
    """Add the commands."""
    product_command(app, "info", InfoRequest, "service.captures.info:inspect", _info)
    product_command(app, "view", ViewRequest, "service.viewing.view_files:view", _view)
    for command in (_solve, _relight, _shade):
        local_command(app, command.__name__[1:], command)


def _info(found: Any) -> None:
    from stage.errors import StageError

    for name, value in found.facts:
        print(f"{name:<12} {value}")
    for finding in found.findings:
        print(f"{'finding':<12} {finding}")
    for fault in found.faults:
        print(f"{'wrong':<12} {fault}")
    if found.faults:
        others = f" (and {len(found.faults) - 1} more, above)" if len(found.faults) > 1 else ""
        raise StageError(f"{found.faults[0]}{others}")


def _view(result: Any) -> None:
    print_lines(view=result.path, frames=result.frames, layers=", ".join(result.layers) or None)
    if result.levels is not None:
        mean, largest = result.levels
        print(f"relight  {result.terms} coefficient images: {mean:.2g} of 255 levels off under lights that they were not made from, "
              f"{largest:.2g} under the worst")
    print_warnings(result.findings)


def _solve(request: SolveRequest, progress: ProgressOption = ProgressStyle.BAR) -> None:
    from stage.capture.sequence import is_sequence

    if is_sequence(request.capture):
        from service.sequences.run import solve_sequence

        print_sequence(with_bar(solve_sequence, request, progress))
        return
    from service.solve.solve import solve

    check_single(request)
    result = with_bar(solve, request, progress)
    print_lines(maps=result.maps_path, report=result.report_path, pixels=counted(result.counts))
    print_warnings(result.warnings)
    if result.suspects:
        worst = ", ".join(f"{suspect.image} by {100 * suspect.misfit:.0f} %" for suspect in result.suspects[:5])
        more = f" and {len(result.suspects) - 5} more" if len(result.suspects) > 5 else ""
        print(f"suspect  lights that disagree with the others: {worst}{more}; check their direction and irradiance")
    if not result.counts.get("ok"):
        raise typer.Exit(1)


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
    print_lines(display=request.display, sheet=request.sheet, nuke=request.nuke, report=request.report)
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
    print_lines(picture=result.path, display=request.display)
    if not result.metric and (request.light or request.sphere or request.rectangle):
        print("scale    the maps have none: places of lights are taken in pixels")
    if result.clipped:
        print(f"clipped  {result.clipped} pixels are brighter than half can hold and stand at its largest value")
    print_warnings(result.warnings)
