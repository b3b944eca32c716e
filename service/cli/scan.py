"""relit scan: shots of a scanning laser as one point cloud."""

import typer

from service.cli.bar import Bar
from service.cli.request_commands import local_command
from service.requests.scan import ScanRequest


def register(app: typer.Typer) -> None:
    """Add the command."""
    local_command(app, "scan", _scan)


def _scan(request: ScanRequest) -> None:
    from service.depth.scan import scan

    with Bar() as bar:
        result = scan(request, bar)
    print(f"points   {result.points_path}")
    print(f"usd      {result.usd_path}")
    if result.las_path is not None:
        print(f"las      {result.las_path}")
    print(f"report   {result.report_path}")
    print(f"shots    {', '.join(f'{count} {name}' for name, count in result.counts.items() if count)}")
