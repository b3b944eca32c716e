"""relit separate: direct and global light."""

import typer

from service.cli.bar import Bar
from service.cli.request_commands import local_command
from service.requests.separate import SeparateRequest


def register(app: typer.Typer) -> None:
    """Add the command."""
    local_command(app, "separate", _separate)


def _separate(request: SeparateRequest) -> None:
    from service.depth.separate import separate

    with Bar() as bar:
        result = separate(request, bar)
    print(f"parts    {result.separation_path}")
    print(f"report   {result.report_path}")
    print(f"global   {100 * result.global_share.get('median', 0.0):.3g} % of the light (median), period of {result.period_px:g} px")
    print(f"pixels   {', '.join(f'{count} {name}' for name, count in result.counts.items() if count)}")
