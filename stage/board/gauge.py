"""Gauge repeatability and reproducibility of measured regions, by analysis of variance.

Source: AIAG, Measurement Systems Analysis, 4th edition, 2010, chapter III, section B (ANOVA method).
"""

import math
from typing import NamedTuple

import numpy as np

POOL_PROBABILITY = 0.25
"""The interaction of parts and operators is pooled with the repeatability where chance alone makes it as large this often or more."""
SPREAD = 6.0
"""Standard deviations that a tolerance is compared with."""
CATEGORIES = 1.41
"""√2, as AIAG rounds it: the number of distinct categories is this times part over gauge variation."""


class GaugeStudy(NamedTuple):
    """Standard deviations of what makes measured values differ, in the unit of the values."""

    repeatability: float
    """How far measurements of one part by one operator scatter (equipment variation)."""
    reproducibility: float | None
    """Between operators, with the interaction of parts and operators (appraiser variation); None with one operator."""
    interaction: float | None
    """How far operators differ from part to part; None where it was pooled, or with one operator."""
    gauge: float
    """Repeatability and reproducibility together (GRR)."""
    part: float
    """Between parts."""
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
    if repeat == 0 or f_tail(base / repeat, crossed_freedom, freedom) < POOL_PROBABILITY:
        interaction = max((base - repeat) / trials, 0.0)
    else:
        freedom += crossed_freedom
        repeat = base = (error + crossed) / freedom
    operator = max((operator_square - base) / (parts * trials), 0.0)
    part = max((part_square - base) / (operators * trials), 0.0)
    return _study(repeat, operator + (interaction or 0.0), interaction, part, freedom)


def f_tail(ratio: float, above: int, below: int) -> float:
    """Return the probability that an F-distributed number exceeds a ratio.

    Args:
        ratio: of two mean squares.
        above, below: degrees of freedom of the numerator and the denominator.

    Source: Abramowitz and Stegun, Handbook of Mathematical Functions, 26.6.2 and 26.5.8 (continued fraction of the incomplete beta).
    """
    if ratio <= 0:
        return 1.0
    return _incomplete_beta(below / (below + above * ratio), below / 2, above / 2)


def _study(repeat: float, operator: float | None, interaction: float | None, part: float, freedom: int) -> GaugeStudy:
    gauge = repeat + (operator or 0.0)
    root = math.sqrt
    return GaugeStudy(root(repeat), None if operator is None else root(operator), None if interaction is None else root(interaction),
                      root(gauge), root(part), root(gauge + part), freedom)


def _incomplete_beta(x: float, a: float, b: float) -> float:
    """Return the regularised incomplete beta function, by its continued fraction, evaluated backwards."""
    if x >= 1:
        return 1.0
    if x > (a + 1) / (a + b + 2):
        return 1 - _incomplete_beta(1 - x, b, a)
    front = math.exp(a * math.log(x) + b * math.log1p(-x) + math.lgamma(a + b) - math.lgamma(a) - math.lgamma(b)) / a if x > 0 else 0.0
    fraction = 1.0
    for m in range(200, 0, -1):  # converges within √max(a, b) terms
        half, odd = divmod(m, 2)
        step = (-(a + half) * (a + b + half) / ((a + 2 * half) * (a + 2 * half + 1)) if odd
                else half * (b - half) / ((a + 2 * half - 1) * (a + 2 * half)))
        fraction = 1 + step * x / fraction
    return front / fraction
