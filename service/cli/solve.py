"""relit solve: maps of a capture."""

from contextlib import nullcontext

import typer

from service.cli.printing import counted, print_warnings
from service.cli.progress import ProgressBar
from service.cli.request_commands import local_command
from service.cli.sequences import check_single, print_sequence
from service.requests.solve import SolveRequest


def register(app: typer.Typer) -> None:
    """Add the command."""
    local_command(app, "solve", _solve)


def _solve(request: SolveRequest) -> None:
    from stage.sequence import is_sequence

    if is_sequence(request.capture):
        from service.sequences.run import solve_sequence

        with ProgressBar() as bar:
            print_sequence(solve_sequence(request, bar))
        return
    from service.cli.ahead import reading_ahead
    from stage.capture import Capture

    check_single(request)
    capture = Capture.open(request.capture, request.pixels)
    with nullcontext() if request.aligned else reading_ahead(capture, request.cache):
        from service.solve.solve import solve
    with ProgressBar() as bar:  # which starts a thread
        result = solve(request, bar, capture=capture)
    print(f"maps     {result.maps_path}")
    print(f"report   {result.report_path}")
    print(f"pixels   {counted(result.counts)}")
    print_warnings(result.warnings)
    if result.suspects:
        worst = ", ".join(f"{suspect.image} by {100 * suspect.misfit:.0f} %" for suspect in result.suspects[:5])
        more = f" and {len(result.suspects) - 5} more" if len(result.suspects) > 5 else ""
        print(f"suspect  lights that disagree with the others: {worst}{more}; check their direction and irradiance")
    if not result.maps.mask.any():
        raise typer.Exit(1)
