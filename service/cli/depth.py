"""relit depth: structured light, laser or time of flight."""

import typer

from service.cli.bar import Bar
from service.cli.request_commands import local_command
from service.requests.depth import DepthRequest


def register(app: typer.Typer) -> None:
    """Add the command."""
    local_command(app, "depth", _depth)


def _depth(request: DepthRequest) -> None:
    from service.depth.depth import depth

    with Bar() as bar:
        result = depth(request, bar)
    print(f"depth    {result.depth_path}")
    print(f"points   {result.points_path}")
    print(f"report   {result.report_path}")
    print(f"method   {result.method}, {result.points} points")
    print(f"pixels   {', '.join(f'{count} {name}' for name, count in result.counts.items() if count)}")
