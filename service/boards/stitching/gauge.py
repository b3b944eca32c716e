"""Gauge repeatability and reproducibility of measured regions, by analysis of variance.

Source: AIAG, Measurement Systems Analysis, 4th edition, 2010, chapter III, section B (ANOVA method).
"""

import math
from typing import NamedTuple

import numpy as np
from scipy.special import fdtrc

POOL_PROBABILITY = 0.25
"""The interaction of parts and operators is pooled with the repeatability where chance alone makes it as large this often or more."""
SPREAD = 6.0
"""Standard deviations that a tolerance is compared with."""
CATEGORIES = 1.41
"""√2, as AIAG rounds it: the number of distinct categories is this times part over gauge variation."""


class GaugeStudy(NamedTuple):
    """Standard deviations of what makes measured values differ, in the unit of the values."""

    repeatability: float
    """Scatter of measurements of one part by one operator (equipment variation)."""
    reproducibility: float | None
    """Variation between operators, with the interaction of parts and operators (appraiser variation); None with one operator."""
    interaction: float | None
    """Variation of the operators' differences from part to part; None where it was pooled, or with one operator."""
    gauge: float
    """Repeatability and reproducibility together (GRR)."""
    part: float
    """Variation between parts."""
    total: float
    degrees_of_freedom: int
    """Degrees of freedom from which the repeatability is known."""

    @property
    def gauge_percent(self) -> float:
        """Return gauge over total variation, per cent (%GRR)."""
        return 100 * self.gauge / self.total if self.total > 0 else 0.0

    @property
    def categories(self) -> int:
        """Return the number of distinct categories of parts that the gauge tells apart (ndc)."""
        return int(CATEGORIES * self.part / self.gauge) if self.gauge > 0 else 0

    def tolerance_percent(self, width: float) -> float:
        """Return six standard deviations of the gauge over the width of a tolerance, per cent."""
        return 100 * SPREAD * self.gauge / width


def gauge_study(values: np.ndarray) -> GaugeStudy:
    """Divide the variance of a crossed study into its parts.

    Args:
        values: [parts, operators, trials], two parts or more and two trials or more.

    Returns:
        The study.

    Raises:
        ValueError: there are fewer parts or trials.
    """
    parts, operators, trials = values.shape
    if parts < 2 or trials < 2:
        raise ValueError(f"there are {parts} parts and {trials} trials: two or more of each are needed")
    mean = values.mean()
    by_part, by_operator, by_cell = values.mean(axis=(1, 2)), values.mean(axis=(0, 2)), values.mean(axis=2)
    part_square = operators * trials * float(((by_part - mean) ** 2).sum()) / (parts - 1)
    error, freedom = float(((values - by_cell[..., None]) ** 2).sum()), parts * operators * (trials - 1)
    if operators == 1:
        repeat = error / freedom
        part = max((part_square - repeat) / trials, 0.0)
        return _study(repeat, None, None, part, freedom)
    operator_square = parts * trials * float(((by_operator - mean) ** 2).sum()) / (operators - 1)
    crossed = trials * float(((by_cell - by_part[:, None] - by_operator[None] + mean) ** 2).sum())
    crossed_freedom = (parts - 1) * (operators - 1)
    interaction: float | None = None
    repeat, base = error / freedom, crossed / crossed_freedom
    if repeat == 0 or fdtrc(crossed_freedom, freedom, base / repeat) < POOL_PROBABILITY:
        interaction = max((base - repeat) / trials, 0.0)
    else:
        freedom += crossed_freedom
        repeat = base = (error + crossed) / freedom
    operator = max((operator_square - base) / (parts * trials), 0.0)
    part = max((part_square - base) / (operators * trials), 0.0)
    return _study(repeat, operator + (interaction or 0.0), interaction, part, freedom)


def _study(repeat: float, operator: float | None, interaction: float | None, part: float, freedom: int) -> GaugeStudy:
    gauge = repeat + (operator or 0.0)
    root = math.sqrt
    return GaugeStudy(root(repeat), None if operator is None else root(operator), None if interaction is None else root(interaction),
                      root(gauge), root(part), root(gauge + part), freedom)
