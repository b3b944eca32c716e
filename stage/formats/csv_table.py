"""Tables of a CSV file whose first line names its columns."""

import csv
from collections.abc import Sequence
from pathlib import Path

from stage import inputs
from stage.errors import ManifestError


def read_table(path: Path, columns: Sequence[str]) -> "csv.DictReader[str]":
    """Return the rows of a table; the names of its columns are in lower case.
    Raises ManifestError if the file is not UTF-8 text, or lacks one of these columns; names it. Raises StorageError if it cannot be
    read."""
    try:
        rows = csv.DictReader(inputs.read_bytes(path).decode("utf-8-sig").splitlines())
    except UnicodeDecodeError as error:
        raise ManifestError(f"{path}: is not UTF-8 text") from error
    heads = [head.strip().lower() for head in rows.fieldnames or ()]
    if missing := [column for column in columns if column not in heads]:
        raise ManifestError(f"{path}: has no column {missing[0]}: its first line names the columns {', '.join(columns)}")
    rows.fieldnames = heads
    return rows
