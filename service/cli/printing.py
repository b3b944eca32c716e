"""Lines that several commands print, and what the commands that take a sequence of captures check."""

import sys
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import typer

if TYPE_CHECKING:
    from service.requests.depth import DepthRequest
    from service.requests.solve import SolveRequest
    from service.sequences.run import SequenceResult


def counted(counts: Mapping[str, int]) -> str:
    """Return the counts above zero with their names, such as `7862 ok, 12 shadowed`."""
    return ", ".join(f"{count} {name}" for name, count in counts.items() if count)


def print_lines(**values: object) -> None:
    """Print a line for each value that is there, behind its name."""
    for name, value in values.items():
        if value is not None:
            print(f"{name:<8} {value}")


def print_warnings(warnings: Sequence[str]) -> None:
    """Print a line for each thing that does not fit."""
    for sentence in warnings:
        print(f"warning  {sentence}")


def tell(sentence: str) -> None:
    """Print a sentence beside the output, while the command goes on."""
    print(f"relit: {sentence}", file=sys.stderr, flush=True)


def print_table(rows: Sequence[Sequence[str]]) -> None:
    """Print rows of equally many cells, in columns as wide as their widest cell."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        print("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip())


def check_single(request: "SolveRequest | DepthRequest") -> None:
    """Raise RequestError if a capture that is no sequence has an option of sequences."""
    from service.errors import RequestError

    for name, given in (("--no-temporal", not request.temporal), ("--frame-rate", request.frame_rate is not None)):
        if given:
            raise RequestError(f"{name}: {request.capture} is one capture, and the option is for a sequence of them")


def print_sequence(result: "SequenceResult") -> None:
    """Print what was made of a sequence, and end with the exit code 1 where no pixel is solved."""
    print(f"steps    {result.sequence_path} ({len(result.names)} steps, {result.kept} done before)")
    print(f"report   {result.report_path}")
    if result.joined is not None:
        print(f"joined   {100 * result.joined:.0f} % of the pixels of consecutive steps agree")
    print_warnings(result.warnings)
    if not result.solved:
        raise typer.Exit(1)
