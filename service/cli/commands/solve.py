"""relit solve: maps of a capture."""

import typer

from service.cli.printing import check_single, counted, print_sequence, print_warnings
from service.cli.progress import ProgressOption, ProgressStyle, with_bar
from service.cli.request_commands import local_command
from service.requests.solve import SolveRequest


def register(app: typer.Typer) -> None:
    """Add the command."""
    local_command(app, "solve", _solve)


def _solve(request: SolveRequest, progress: ProgressOption = ProgressStyle.BAR) -> None:
    from stage.capture.sequence import is_sequence

    if is_sequence(request.capture):
        from service.sequences.run import solve_sequence

        print_sequence(with_bar(solve_sequence, request, progress))
        return
    from service.solve.solve import solve

    check_single(request)
    result = with_bar(solve, request, progress)
    print(f"maps     {result.maps_path}")
    print(f"report   {result.report_path}")
    print(f"pixels   {counted(result.counts)}")
    print_warnings(result.warnings)
    if result.suspects:
        worst = ", ".join(f"{suspect.image} by {100 * suspect.misfit:.0f} %" for suspect in result.suspects[:5])
        more = f" and {len(result.suspects) - 5} more" if len(result.suspects) > 5 else ""
        print(f"suspect  lights that disagree with the others: {worst}{more}; check their direction and irradiance")
    if not result.counts.get("ok"):
        raise typer.Exit(1)
