"""Tables of a CSV file whose first line names its columns."""

import csv
import io
import re
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from stage import inputs
from stage.errors import ManifestError

DECIMAL_COMMA = re.compile(r"([-+]?\d*),(\d+(?:[eE][-+]?\d+)?)")


def with_point(text: str) -> str:
    """Return a number that has a decimal comma with a point, and any other text as it is."""
    return DECIMAL_COMMA.sub(r"\1.\2", text) if DECIMAL_COMMA.fullmatch(text) else text


def read_table(path: Path, columns: Sequence[str]) -> "csv.DictReader[str]":
    """Return the rows of a table; the names of its columns are in lower case.
    Where semicolons or tabs part the columns, numbers may have decimal commas.
    Raises ManifestError if the file is not UTF-8 text, lacks one of these columns, or has a line with more cells than columns; names it.
    Raises StorageError if it cannot be read."""
    try:
        lines = inputs.read_bytes(path).decode("utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise ManifestError(f"{path}: is not UTF-8 text") from error
    separator = next((mark for mark in ";\t" if lines and mark in lines[0]), None)
    if separator is not None:
        lines = list(_with_commas(lines, separator))
    rows = csv.DictReader(lines)
    heads = [head.strip().lower() for head in rows.fieldnames or ()]
    if missing := [column for column in columns if column not in heads]:
        raise ManifestError(f"{path}: has no column {missing[0]}: its first line names the columns {', '.join(columns)}")
    rows.fieldnames = heads
    cells = csv.reader(lines)
    for row in cells:
        if any(cell.strip() for cell in row[len(heads):]):
            hint = ": part columns by semicolons where numbers have decimal commas" if separator is None else ""
            raise ManifestError(f"{path}: line {cells.line_num}: has {len(row)} cells, the first line names {len(heads)} columns{hint}")
    return rows


def table_text(columns: Sequence[str], rows: Iterable[Iterable[object]]) -> str:
    """Return rows under the names of their columns as CSV; None is an empty cell."""
    out = io.StringIO()
    table = csv.writer(out, lineterminator="\n")
    table.writerow(columns)
    table.writerows(rows)
    return out.getvalue()


def _with_commas(lines: Sequence[str], separator: str) -> Iterator[str]:
    """Yield the lines of a table whose columns another separator parts as one with commas."""
    for row in csv.reader(lines, delimiter=separator):
        yield ",".join('"' + with_point(cell.strip()).replace('"', '""') + '"' for cell in row)
