"""relit shade: solved maps under near lights, area lights and an environment."""

import typer

from service.cli.bar import ProgressStyle, show
from service.cli.options import ProgressOption
from service.cli.request_commands import local_command
from service.requests.shade import ShadeRequest


def register(app: typer.Typer) -> None:
    """Add the command."""
    local_command(app, "shade", _shade)


def _shade(request: ShadeRequest, progress: ProgressOption = ProgressStyle.BAR) -> None:
    from service.light.shade import shade

    with show(progress) as bar:
        result = shade(request, bar)
    print(f"picture  {result.path}")
    if not result.metric:
        print("scale    the maps have none: places of lights are taken in pixels")
    if result.clipped:
        print(f"clipped  {result.clipped} pixels are brighter than half can hold and stand at its largest value")
