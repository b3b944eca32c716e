"""The ranges that either kind of time of flight gives, before filters."""

from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True)
class RangeImage:
    """Ranges along the rays, before correction and filters; only pixels with a status of kernels.status.SOLVED have values that count."""

    method: str
    range_m: np.ndarray  # [pixel] float32
    sigma_m: np.ndarray  # [pixel] float32
    amplitude: np.ndarray  # [pixel] float32
    confidence: np.ndarray  # [pixel] float32
    status: np.ndarray  # [pixel] int32
    facts: dict[str, Any]
