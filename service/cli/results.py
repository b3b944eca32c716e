"""relit solve, relit export: results out."""

import typer

from service.cli.bar import Bar
from service.cli.request_commands import local_command
from service.requests.export import ExportRequest
from service.requests.solve import SolveRequest


def register(app: typer.Typer) -> None:
    """Add the commands."""
    local_command(app, "solve", _solve)
    local_command(app, "export", _export)


def _solve(request: SolveRequest) -> None:
    from service.solve.solve import solve

    with Bar() as bar:
        result = solve(request, bar)
    print(f"maps     {result.maps_path}")
    print(f"report   {result.report_path}")
    print(f"pixels   {', '.join(f'{count} {name}' for name, count in result.counts.items() if count)}")
    if result.suspects:
        worst = ", ".join(f"{suspect.image} by {100 * suspect.misfit:.0f} %" for suspect in result.suspects[:5])
        more = f" and {len(result.suspects) - 5} more" if len(result.suspects) > 5 else ""
        print(f"suspect  lights that disagree with the others: {worst}{more}; check their direction and irradiance")


def _export(request: ExportRequest) -> None:
    from service.usd.export import export

    with Bar() as bar:
        print(f"asset    {export(request, bar)}")
