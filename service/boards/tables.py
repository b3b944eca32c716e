"""Tables of boards as CSV, and their numbers of six digits."""

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from typing import Any


def table_text(columns: Sequence[str], rows: Iterable[Mapping[str, Any]]) -> str:
    """Return rows under their columns as CSV; a column that a row lacks is empty."""
    out = io.StringIO()
    table = csv.DictWriter(out, columns, lineterminator="\n")
    table.writeheader()
    table.writerows(rows)
    return out.getvalue()


def six_digits(value: float) -> float:
    """Return a number rounded to six digits."""
    return float(f"{value:.6g}")


def rounded(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return values whose floats have six digits."""
    return {key: six_digits(value) if isinstance(value, float) else value for key, value in values.items()}
