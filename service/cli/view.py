"""relit view: what a browser needs to show a capture and its maps."""

import typer

from service.cli.printing import print_warnings
from service.cli.progress import ProgressBar
from service.cli.request_commands import local_command
from service.requests.view import ViewRequest


def register(app: typer.Typer) -> None:
    """Add the command."""
    local_command(app, "view", _view)


def _view(request: ViewRequest) -> None:
    from service.viewing.view import view

    with ProgressBar() as bar:
        result = view(request, bar)
    print(f"view     {result.path}")
    print(f"frames   {result.frames}")
    if result.layers:
        print(f"layers   {', '.join(result.layers)}")
    if result.levels is not None:
        mean, largest = result.levels
        print(f"relight  {result.terms} coefficient images: {mean:.2g} of 255 levels off under lights that they were not made from, "
              f"{largest:.2g} under the worst")
    print_warnings(result.findings)
