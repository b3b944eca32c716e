"""Ranges and histograms of layers."""

from typing import Any

import numpy as np

from stage.light_basis import numbers

BINS = 64
RANGE_PERCENTILES = (1, 99)
"""What a display maps to black and white at first."""
HISTOGRAM_PERCENTILES = (0.1, 99.9)
"""Where a histogram begins and ends, so that a few wild values do not squeeze the rest into one bin."""


def range_of(values: np.ndarray, valid: np.ndarray) -> tuple[float, float]:
    """Return the 1st and 99th percentile of the valid pixels over all channels; 0 and 0 where there is none.

    Args:
        values: [channels, rows, cols].
        valid: [rows, cols] bool.
    """
    return _percentiles(values[:, valid], RANGE_PERCENTILES)


def histogram_of(values: np.ndarray, valid: np.ndarray) -> dict[str, Any]:
    """Return `low`, `high` and `counts` [channels][64] of the valid pixels; values beyond count in the first and last bin.

    Args:
        values: [channels, rows, cols].
        valid: [rows, cols] bool.
    """
    chosen = values[:, valid].astype(np.float32)
    low, high = _percentiles(chosen, HISTOGRAM_PERCENTILES)
    width = high - low or 1.0
    places = np.clip((chosen - low) * (BINS / width), 0, BINS - 1).astype(np.uint8)
    return {"low": numbers(low), "high": numbers(high), "counts": [np.bincount(row, minlength=BINS).tolist() for row in places]}


def code_counts(codes: np.ndarray, counted: np.ndarray) -> dict[str, Any]:
    """Return the codes that occur as `range`, and as `histogram` how many of the counted pixels have each code 0 … 63.

    Args:
        codes: [rows, cols] uint8.
        counted: [rows, cols] bool.
    """
    counts = np.bincount(np.minimum(codes[counted], BINS - 1), minlength=BINS)
    return {"range": np.flatnonzero(np.bincount(codes.reshape(-1))).tolist(),
            "histogram": {"low": 0, "high": BINS, "counts": [counts.tolist()]}}


def _percentiles(values: np.ndarray, of: tuple[float, float]) -> tuple[float, float]:
    if not values.size:
        return 0.0, 0.0
    low, high = np.percentile(values.astype(np.float32), of)
    return float(low), float(high)
