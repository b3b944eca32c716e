"""The ranges that either kind of time of flight gives, before filters."""

from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True)
class RangeImage:
    """Ranges along the rays, before correction and filters; pixels with a status of kernels.status.ESTIMATED have values that count."""

    method: str
    range_m: np.ndarray  # [pixel] float32
    sigma_m: np.ndarray  # [pixel] float32
    amplitude: np.ndarray  # [pixel] float32
    confidence: np.ndarray  # [pixel] float32
    status: np.ndarray  # [pixel] int32
    facts: dict[str, Any]
    least_confidence: float = 0.0
    """Least confidence of a range that counts as solved, where the request names none."""
    warnings: tuple[str, ...] = ()
    """A sentence for each thing that does not fit on the whole scene."""
