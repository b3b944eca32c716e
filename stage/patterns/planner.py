"""Before projecting: how many images a code takes, how long that lasts, and how precise the depth will be.

The counts are those of the lecture, in which code 0 (no light) is not used: N stripes need ⌈log2(N + 1)⌉ binary images. What
is projected here numbers stripes from 0 and may add inverses and white and black; both counts are given.

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

from typing import NamedTuple

import numpy as np

from stage.patterns.stripes import digit_count


class Rig(NamedTuple):
    """What the precision depends on."""

    baseline_m: float
    distance_m: float
    focal_px: float
    """Of the projector, in its pixels."""
    noise: float
    """Standard deviation of a reading over the amplitude of the pattern in it (half of white minus black)."""


class Plan(NamedTuple):
    """One line of the planner's table."""

    name: str
    minimum: int
    """Images of one axis as the lecture counts."""
    images: int
    """As projected here."""
    seconds: float
    """To capture them."""
    column_sigma_px: float
    depth_sigma_m: float | None
    """None without a rig."""


def point_count(columns: int, rows: int) -> int:
    """Images to light every projector pixel by itself."""
    return columns * rows


def line_count(columns: int) -> int:
    """Images to light every column by itself."""
    return columns


def kary_count(columns: int, base: int = 2) -> int:
    """⌈log_k(N + 1)⌉: images that number N stripes in base k when code 0 is not used.

    Raises:
        ValueError: no stripe, or a base under 2.
    """
    return digit_count(columns + 1, base) if columns >= 1 else digit_count(columns, base)


RATIO_COUNT = 2
"""Images of the intensity ratio."""
PHASE_COUNT = 3
"""Images of phase shifting over one period."""


def stripe_sigma(stripe_px: float) -> float:
    """Standard deviation of a place somewhere in a stripe, projector pixels."""
    return stripe_px / float(np.sqrt(12))


def phase_sigma(periods_px: tuple[float, ...], steps: int, noise: float) -> float:
    """Standard deviation of the column from N steps of each period, projector pixels; noise is over the amplitude."""
    information = sum((2 * np.pi / period) ** 2 * steps / 2 for period in periods_px) / noise**2
    return float(1 / np.sqrt(information))


def ramp_sigma(columns: int, noise: float) -> float:
    """Standard deviation of the column from up / (up + down), RMS over the ramp, projector pixels."""
    return columns * float(np.sqrt(2 / 3)) * noise / 2


def micro_sigma(mean_period_px: float, periods: int, noise: float) -> float:
    """Standard deviation of the column from micro phase shifting, projector pixels."""
    return phase_sigma((mean_period_px,), periods + 2, noise)


def modulated_sigma(period_px: float, steps: int, carrier_steps: int, noise: float) -> float:
    """Standard deviation of the column from modulated phase shifting, projector pixels.

    The carrier's amplitude at a step is (1 + cos)/2 · B with deviation √(2/M) σ; the phase's amplitude over the steps is B/2.
    """
    return period_px / (2 * np.pi) * float(np.sqrt(2 / steps) * np.sqrt(2 / carrier_steps)) * noise * 2


def depth_sigma(rig: Rig, column_sigma_px: float) -> float:
    """σ_Z = Z² σ_u / (f b), metres.

    Raises:
        ValueError: a distance, baseline or focal length that is not above zero.
    """
    for name, value in (("baseline", rig.baseline_m), ("distance", rig.distance_m), ("focal length", rig.focal_px)):
        if not value > 0:
            raise ValueError(f"the {name} is {value:g}: give more than 0")
    return rig.distance_m**2 * column_sigma_px / (rig.focal_px * rig.baseline_m)


def plan(columns: int, rows: int, *, frame_rate: float, noise: float = 0.02, rig: Rig | None = None, base: int = 3,
         periods_px: tuple[float, ...] = (16, 18, 21), steps: int = 4, micro: int = 5) -> tuple[Plan, ...]:
    """The table for one axis of a projector.

    Args:
        columns: N, stripes to tell apart.
        rows: M, for lighting point by point.
        frame_rate: images a second.
        noise: of a reading over the amplitude; a rig brings its own.
        rig: for the depth; None: columns alone.
        base: k of the k-ary code.
        periods_px: of phase shifting.
        steps: of each period.
        micro: periods of micro phase shifting, about the mean of periods_px.

    Raises:
        ValueError: a frame rate or noise that is not above zero, or what the codes refuse.
    """
    if not frame_rate > 0:
        raise ValueError(f"the frame rate is {frame_rate:g}: give images a second, more than 0")
    noise = noise if rig is None else rig.noise
    if not noise > 0:
        raise ValueError(f"the noise is {noise:g}: give its standard deviation over the amplitude, more than 0")
    bits, digits = digit_count(columns, 2), digit_count(columns, base)
    one, mean = stripe_sigma(1), float(np.mean(periods_px))
    listed = ", ".join(f"{period:g}" for period in periods_px)
    rows_of = [("point", point_count(columns, rows), point_count(columns, rows), one),
               ("line", line_count(columns), line_count(columns), one),
               ("binary or gray, with inverses", kary_count(columns), 2 * bits + 2, one),
               ("xor, with inverses", kary_count(columns), 2 * bits + 2, one),
               (f"kary, base {base}", kary_count(columns, base), digits + 2, one),
               ("ramp", RATIO_COUNT, RATIO_COUNT + 2, ramp_sigma(columns, noise)),
               (f"phase, {steps} steps of {listed} px", PHASE_COUNT, steps * len(periods_px), phase_sigma(tuple(periods_px), steps, noise)),
               (f"micro, {micro} periods about {mean:g} px", micro + 2, micro + 2, micro_sigma(mean, micro, noise)),
               (f"modulated, {steps} steps over 3", 9, 3 * steps, modulated_sigma(columns, steps, 3, noise))]
    return tuple(Plan(name, minimum, images, images / frame_rate, sigma, None if rig is None else depth_sigma(rig, sigma))
                 for name, minimum, images, sigma in rows_of)
