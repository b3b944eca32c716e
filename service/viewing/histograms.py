"""Ranges and histograms of layers."""

from typing import Any

import numpy as np

from stage.light_basis import numbers

BINS = 64
RANGE_PERCENTILES = (1, 99)
"""What a display maps to black and white at first."""
HISTOGRAM_PERCENTILES = (0.1, 99.9)
"""Where a histogram begins and ends, so that a few wild values do not squeeze the rest into one bin."""


def statistics_of(values: np.ndarray, valid: np.ndarray) -> dict[str, Any]:
    """Return `range` and `histogram` of the valid pixels of a layer; all are 0 where there is none.

    The range is [1st, 99th percentile] over all channels. The histogram has `low`, `high` and `counts` [channels][64]; values beyond count
    in the first and last bin.

    Args:
        values: [channels, rows, cols].
        valid: [rows, cols] bool.
    """
    chosen = values[:, valid].astype(np.float32, copy=False)
    of = (HISTOGRAM_PERCENTILES[0], *RANGE_PERCENTILES, HISTOGRAM_PERCENTILES[1])
    low, first, last, high = (float(value) for value in np.percentile(chosen, of)) if chosen.size else (0.0, 0.0, 0.0, 0.0)
    counts = [np.histogram(np.clip(row, low, high), bins=BINS, range=(low, high))[0].tolist() for row in chosen]
    return {"range": numbers([first, last]), "histogram": {"low": numbers(low), "high": numbers(high), "counts": counts}}


def code_counts(codes: np.ndarray, counted: np.ndarray) -> dict[str, Any]:
    """Return the codes that occur as `range`, and as `histogram` how many of the counted pixels have each code 0 … 63.

    Args:
        codes: [rows, cols] uint8.
        counted: [rows, cols] bool.
    """
    counts = np.bincount(np.minimum(codes[counted], BINS - 1), minlength=BINS)
    return {"range": np.flatnonzero(np.bincount(codes.reshape(-1))).tolist(),
            "histogram": {"low": 0, "high": BINS, "counts": [counts.tolist()]}}
