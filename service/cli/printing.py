"""Lines that several commands print."""

from collections.abc import Mapping, Sequence


def counted(counts: Mapping[str, int]) -> str:
    """Return the counts above zero with their names, such as `7862 ok, 12 shadowed`."""
    return ", ".join(f"{count} {name}" for name, count in counts.items() if count)


def print_warnings(warnings: Sequence[str]) -> None:
    """Print a line for each thing that does not fit."""
    for sentence in warnings:
        print(f"warning  {sentence}")


def print_table(rows: Sequence[Sequence[str]]) -> None:
    """Print rows of equally many cells, in columns as wide as their widest cell."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        print("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip())
