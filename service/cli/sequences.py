"""What the commands that take a sequence of captures check and print."""

from typing import TYPE_CHECKING

import typer

from service.cli.printing import print_warnings
from service.errors import RequestError

if TYPE_CHECKING:
    from service.requests.depth import DepthRequest
    from service.requests.solve import SolveRequest
    from service.sequences.run import SequenceResult


def check_single(request: "SolveRequest | DepthRequest") -> None:
    """Check that a capture that is no sequence has no option of sequences.

    Raises:
        RequestError: it has.
    """
    for name, given in (("--no-temporal", not request.temporal), ("--frame-rate", request.frame_rate is not None)):
        if given:
            raise RequestError(f"{name}: {request.capture} is one capture, and the option is for a sequence of them")


def print_sequence(result: "SequenceResult") -> None:
    """Print what was made of a sequence, and end with the exit code 1 where no pixel is solved."""
    print(f"steps    {result.sequence_path} ({len(result.names)} steps, {result.kept} done before)")
    print(f"report   {result.report_path}")
    print(f"joined   {100 * result.joined:.0f} % of the pixels of consecutive steps agree")
    print_warnings(result.warnings)
    if not result.solved:
        raise typer.Exit(1)
