"""Predict before projecting the number of images of a code, their duration, and the precision of the depth.

The minimum counts are those of Nayar's lecture 3-5, in which code 0 (no light) is not used: N stripes need ⌈log2(N + 1)⌉ binary images.
What is projected here numbers stripes from 0 and may add inverses and white and black; both counts are given. The line of each code stands
in service/depth/patterns/codes.py.

Depth: a projector column is a plane; a camera beside it at baseline b, both of focal length f projector pixels, sees depth
Z = f b / d at disparity d, so a standard deviation σ_u of the column gives σ_Z = Z² σ_u / (f b). Deviations of the column:

    numbered stripes of width s (point, line, binary, k-ary, xor)   s / √12, the standard deviation of an even distribution
    phase, N steps of a period P, noise σ over amplitude B          P / 2π · √(2 / N) · σ/B; several periods add their information
    intensity ratio up / (up + down), columns W                     W · √(2/3) · σ / 2B, the mean over the ramp
    micro, frames of about one period P                             P / 2π · √(2 / frames) · σ/B
    modulated, N steps of P over M carrier steps                    P / 2π · √(2 / N) · √(2 / M) · 2 σ/B

Source: Nayar, First Principles of Computer Vision, 3-5 (counts); error of phase shifting: Surrel, "Additive noise effect in
digital phase detection", Applied Optics 1997, equation 21.
"""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from stage.patterns.base import digit_count


class Rig(NamedTuple):
    """The geometry that the precision of a depth depends on."""

    baseline_m: float
    distance_m: float
    focal_px: float
    """Focal length of the projector, in its pixels."""


class Cost(NamedTuple):
    """The cost and the precision of one axis of a code."""

    name: str
    minimum: int
    """Images of one axis by the count of Nayar's lecture 3-5."""
    images: int
    """Images as projected here."""
    column_sigma_px: float
    """Standard deviation of the column, projector pixels."""


class Plan(NamedTuple):
    """One line of the planner's table."""

    cost: Cost
    seconds: float
    """Time to capture the images."""
    depth_sigma_m: float | None
    """Standard deviation of the depth, metres; None without a rig."""


def kary_count(columns: int, base: int = 2) -> int:
    """Return ⌈log_k(N + 1)⌉: images that number N stripes in base k when code 0 is not used."""
    return digit_count(columns + 1, base) if columns >= 1 else digit_count(columns, base)


RATIO_COUNT = 2
"""Images of the intensity ratio."""
PHASE_COUNT = 3
"""Images of phase shifting over one period."""
STRIPE_SIGMA = 12**-0.5
"""Standard deviation of a place somewhere in a stripe that is one projector pixel wide, projector pixels."""


def phase_sigma(periods_px: tuple[float, ...], steps: int, noise: float) -> float:
    """Return the standard deviation of the column from N steps of each period, projector pixels.

    `noise` is the standard deviation of a reading over the amplitude of the pattern in it (half of white minus black), here and below.
    """
    information = sum((2 * np.pi / period) ** 2 * steps / 2 for period in periods_px) / noise**2
    return float(1 / np.sqrt(information))


def ramp_sigma(columns: int, noise: float) -> float:
    """Return the standard deviation of the column from up / (up + down), RMS over the ramp, projector pixels."""
    return columns * float(np.sqrt(2 / 3)) * noise / 2


def modulated_sigma(period_px: float, steps: int, carrier_steps: int, noise: float) -> float:
    """Return the standard deviation of the column from modulated phase shifting, projector pixels.

    The carrier's amplitude at a step is (1 + cos)/2 · B with deviation √(2/M) σ; the phase's amplitude over the steps is B/2.
    """
    return period_px / (2 * np.pi) * float(np.sqrt(2 / steps) * np.sqrt(2 / carrier_steps)) * noise * 2


def depth_sigma(rig: Rig, column_sigma_px: float) -> float:
    """Return the standard deviation of the depth, σ_Z = Z² σ_u / (f b), metres."""
    for name, value in (("baseline", rig.baseline_m), ("distance", rig.distance_m), ("focal length", rig.focal_px)):
        if not value > 0:
            raise ValueError(f"the {name} is {value:g}: give more than 0")
    return rig.distance_m**2 * column_sigma_px / (rig.focal_px * rig.baseline_m)


def tabulate(costs: Iterable[Cost], *, frame_rate: float, rig: Rig | None = None) -> tuple[Plan, ...]:
    """Return the table: what each code costs in time and, with a rig, how precise its depth is."""
    if not frame_rate > 0:
        raise ValueError(f"the frame rate is {frame_rate:g}: give images a second, more than 0")
    return tuple(Plan(cost, cost.images / frame_rate, None if rig is None else depth_sigma(rig, cost.column_sigma_px)) for cost in costs)
