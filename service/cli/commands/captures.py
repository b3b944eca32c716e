"""relit info and relit view: look at a capture, here and in a browser."""

import typer

from service.cli.printing import print_warnings
from service.cli.progress import with_bar
from service.cli.request_commands import local_command
from service.requests.captures import InfoRequest, ViewRequest


def register(app: typer.Typer) -> None:
    """Add the commands."""
    local_command(app, "info", _info)
    local_command(app, "view", _view)


def _info(request: InfoRequest) -> None:
    from service.captures.info import inspect
    from stage.errors import StageError

    found = with_bar(inspect, request)
    for name, value in found.facts:
        print(f"{name:<12} {value}")
    for finding in found.findings:
        print(f"{'finding':<12} {finding}")
    for fault in found.faults:
        print(f"{'wrong':<12} {fault}")
    if found.faults:
        others = f" (and {len(found.faults) - 1} more, above)" if len(found.faults) > 1 else ""
        raise StageError(f"{found.faults[0]}{others}")


def _view(request: ViewRequest) -> None:
    from service.viewing.view_files import view

    result = with_bar(view, request)
    print(f"view     {result.path}")
    print(f"frames   {result.frames}")
    if result.layers:
        print(f"layers   {', '.join(result.layers)}")
    if result.levels is not None:
        mean, largest = result.levels
        print(f"relight  {result.terms} coefficient images: {mean:.2g} of 255 levels off under lights that they were not made from, "
              f"{largest:.2g} under the worst")
    print_warnings(result.findings)
