"""The stripe of one laser frame: its centre on each line, how sure it is on textured surfaces, and which of several stripes it is.

The albedo of the pixels that a sweep of laser planes lights, from the sweep itself.

While the planes pass over a pixel, it reads its albedo times the profile of the stripe, sampled at the planes. The energy Σ I² over the
frames is then the albedo squared times the same constant for every pixel, if the planes lie close enough: a Gaussian profile of standard
deviation s planes leaves a ripple of 2 exp(-π² s²), 0.4 % at s = 0.8. The number of frames that share the energy, (Σ I²)² / Σ I⁴ = 2.5 s,
tells where they do, and where the sweep begins or ends over a pixel.

Source: Curless and Levoy, "Better optical triangulation through spacetime analysis", ICCV 1995: over the frames, texture does not bend the
profile of a pixel.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.ndimage import uniform_filter

from kernels.device import to_numpy
from kernels.status import Status
from kernels.structured.stripe import REACH, find_stripe, plane_depths
from service.depth.laser.background import background
from service.depth.laser.stripe_curves import PEAKS, Chosen, choose_curves
from service.depth.laser.stripe_map import StripeMap, StripeSamples
from stage.capture.camera import Camera
from stage.capture.light import LaserPlane

ENOUGH = 30
"""Number of pixels under both sweeps from which on these are compared."""
CLEAR_SIGMAS = 3.0
"""Median difference of two sweeps, in deviations, from which on they contradict each other."""
LEAST_FRAMES = 2.0
"""Least number of frames that share the energy of a pixel: with fewer, the ripple is above 0.4 %."""
LEAST_PART = 0.75
"""Least part of the commonest number of frames: where the sweep ends over a pixel, part of its energy is missing."""
SIGNIFICANT = 3.0
"""Standard deviations of the noise from which a reading counts as light of the stripe."""
LEAST_SIGNAL = 10.0
"""Least root of the energy in standard deviations of the noise: the albedo is then known to a tenth."""
WINDOW_PX = 5
"""Side of the window over which the texture of the albedo is compared with its noise, pixels."""


class Signal(NamedTuple):
    """One frame less its background."""

    values: np.ndarray  # [rows, cols] float32, 0 outside the mask
    channel: int
    noise: float
    """Standard deviation where there is no stripe."""


class Sweep:
    """The albedo of surfaces, from the energy of each pixel over the frames of planes that cross the same lines."""

    def __init__(self) -> None:
        self._channel = 0
        self._square: np.ndarray | None = None  # Σ I², [rows, cols]
        self._fourth: np.ndarray | None = None  # Σ I⁴
        self._noise2 = 0.0
        self._frames = 0
        self._albedo: np.ndarray | None = None

    def add(self, signal: Signal) -> None:
        """Add a frame; those of another channel than the first take no part."""
        if self._square is None or self._fourth is None:
            self._channel = signal.channel
            self._square, self._fourth = np.zeros(signal.values.shape, np.float32), np.zeros(signal.values.shape, np.float32)
        if signal.channel != self._channel:
            return
        square = np.where(signal.values > SIGNIFICANT * signal.noise, signal.values, 0).astype(np.float32) ** 2
        self._square += square
        self._fourth += square * square
        self._noise2 += signal.noise * signal.noise
        self._frames += 1

    def albedo_for(self, signal: Signal) -> np.ndarray | None:
        """Return the albedo in the channel of a frame, or None."""
        return self._albedo if signal.channel == self._channel else None

    def close(self) -> None:
        """Compute the albedo, and let the frames go."""
        if self._square is not None and self._fourth is not None and self._frames >= LEAST_FRAMES:
            self._albedo = _relative_albedo(self._square, self._fourth, self._noise2 / self._frames)
        self._square = self._fourth = None


def _relative_albedo(energy: np.ndarray, fourth: np.ndarray, noise2: float) -> np.ndarray | None:
    """Return the relative albedo, [rows, cols] float32, 0 where the sweep does not tell it; None if it tells it nowhere.

    Texture that does not stand out of its noise is smoothed (Lee, "Digital image enhancement and noise filtering by use of local
    statistics", PAMI 1980): there a division by it would only add noise.
    """
    lit = energy > LEAST_SIGNAL**2 * noise2
    shared = np.where(lit, energy**2 / np.where(lit, fourth, 1), 0).astype(np.float32)
    around = _mean(shared, lit)
    known = lit & (around >= LEAST_FRAMES)
    if not known.any():
        return None
    known &= shared >= LEAST_PART * np.median(shared[known])
    root = np.sqrt(energy)
    middle = _mean(root, known)
    variance = np.maximum(_mean(root * root, known) - middle * middle, 0)
    texture = np.maximum(1 - noise2 / np.maximum(variance, 1e-12 * noise2 + 1e-30), 0)
    found = middle + texture * (root - middle)
    return np.where(known & (found > 0), found, 0).astype(np.float32)


def _mean(values: np.ndarray, where: np.ndarray) -> np.ndarray:
    """Return the mean of the values over a window, of those pixels that are marked; 0 where none is."""
    total, weight = (uniform_filter(each, WINDOW_PX, output=np.float64, mode="constant") for each in (np.where(where, values, 0), where))
    return np.asarray(total / np.maximum(weight, 1e-6))


NOISE_SAMPLE = 200_000
"""Number of pixels from which the noise of a frame is estimated."""
BESIDE_LINES, FURTHER_LINES = 4, 12
"""Lines to either side over which odd residuals, and changes of brightness along the stripe, are averaged: a line sees few pixels, and
fields of an even albedo change at their borders alone."""
CUT = 3.0
"""Odd residuals of a single line, in standard deviations by noise, from which they count whatever the lines beside it show."""
NARROW, CUT_SHIFT = 0.9, 2.0
"""Part of the usual width of the frame below which a profile is taken to be cut by the edge of a surface, and how far that shifts its
centre over the width that it loses: half a Gaussian has lost 0.4 of its standard deviation, and its centre has moved by 0.8."""
SAME_CURVE_PX = 4.0
"""Largest step of the centre per line between two lines that see one surface."""


def stripe_signal(radiance: np.ndarray, mask: np.ndarray) -> Signal:
    """Return the brightest channel of a frame, with its median as zero.
    `radiance`: [rows, cols, 3] float32, less ambient light. `mask`: [rows, cols] bool, not empty."""
    channel = int(np.argmax(np.where(mask[..., None], radiance, 0).max(axis=(0, 1))))
    inside = radiance[..., channel][mask]
    few = inside[:: max(1, len(inside) // NOISE_SAMPLE)]
    middle, noise = background(few, max(1e-6 * float(inside.max()), 1e-12))
    return Signal(np.where(mask, radiance[..., channel] - middle, 0), channel, noise)


def along_of(laser: LaserPlane) -> str:
    """Return "row" if the stripe crosses the rows of the image, "column" if it crosses the columns."""
    return "row" if abs(laser.normal[0]) >= abs(laser.normal[1]) else "column"


class Stripes(NamedTuple):
    """The stripes of one frame."""

    samples: StripeSamples
    curve: np.ndarray
    """[lines] int, number of the curve of the stripe on each line, -1 where there is none."""
    doubled: int
    """Number of lines with two stripes of comparable brightness."""
    second: int
    """Number of lines with a second stripe, of a tenth of the brightness or more."""


def measure_stripe(signal: Signal, mask: np.ndarray, laser: LaserPlane, sweep: Sweep, camera: Camera, *, device: str, near_m: float,
                   far_m: float) -> Stripes:
    """Measure the stripe of one frame on each line; depths outside the span are OUT_OF_RANGE.
    `sweep`: of the frames whose stripes cross the same lines."""
    along = along_of(laser)
    place, sigma, brightness, amplitude, status = _peaks(signal, along, sweep, device)
    chosen: Chosen = choose_curves(place, brightness, status)
    lines = np.arange(place.shape[1])
    centre, spread_px, peak = (values[chosen.peak, lines] for values in (place, sigma, amplitude))
    code = chosen.status.copy()
    code[~mask.any(axis=1 if along == "row" else 0)] = Status.UNSOLVED
    u, v = (centre.astype(np.float64), lines + 0.5) if along == "row" else (lines + 0.5, centre.astype(np.float64))
    x, y = camera.plane_at(u, v)
    met = plane_depths(x, y, np.array(laser.point_m), np.array(laser.normal), along=along)
    assert camera.focal_px is not None
    found = np.isin(code, (Status.OK, Status.MULTIPATH))
    with np.errstate(invalid="ignore"):
        near = np.isfinite(met.depth) & (met.depth >= near_m) & (met.depth <= far_m)
    code[found & ~near] = Status.OUT_OF_RANGE
    spread = spread_px * met.per_pixel / camera.focal_px[0 if along == "row" else 1]
    if laser.accuracy_deg:
        spread = np.hypot(spread, np.radians(laser.accuracy_deg) * depth_per_turn(x, y, met.depth, laser))
        if laser.accuracy_m:
            spread = np.hypot(spread, laser.accuracy_m * _depth_per_shift(x, y, laser))
    return Stripes(StripeSamples(lines, centre, np.nan_to_num(met.depth), np.nan_to_num(spread), peak, code), chosen.curve,
                   int(chosen.doubled.sum()), int(chosen.second.sum()))


def _peaks(signal: Signal, along: str, sweep: Sweep, device: str) -> tuple[np.ndarray, ...]:
    """Return centre, deviation, brightness, peak and status of the brightest stripes of each line, [PEAKS, lines] each.

    After a stripe is found, its pixels are taken out and the next is looked for.
    """
    left = signal.values.copy()
    rows: list[tuple[np.ndarray, ...]] = []
    for _ in range(PEAKS):
        found = find_stripe(left, along=along, noise=signal.noise, device=device, albedo=sweep.albedo_for(signal), rival=np.inf)
        centre, sigma, uneven, width, level, even, amplitude, status = (to_numpy(array) for array in found)
        rows.append((centre, _deviation(centre, sigma, uneven, width, level, even, status, signal.noise), level, amplitude, status))
        if not (status == Status.OK).any():
            break
        image = left if along == "row" else left.T
        away = np.abs(np.arange(image.shape[1])[None] + 0.5 - centre[:, None])
        image[(away <= REACH * np.maximum(width, 1.0)[:, None]) & (status == Status.OK)[:, None]] = 0
        image[status != Status.OK] = 0
    return tuple(np.stack(values) for values in zip(*rows, strict=True))


def _deviation(centre: np.ndarray, sigma: np.ndarray, uneven: np.ndarray, width: np.ndarray, level: np.ndarray, even: np.ndarray,
               status: np.ndarray, noise: float) -> np.ndarray:
    """Return the standard deviation of each centre from noise and texture, pixels.

    Texture shows in two ways: as odd residuals of the profile, and as changes of the brightness along the stripe. A gradient of the albedo
    across the stripe shifts it without a residual; if texture is alike in all directions, brightness at a distance of √2 standard
    deviations of the profile, w, then changes by as much: the shift is w/√2 times the change of its logarithm. The latter counts only where
    the albedo was not divided out.
    """
    ok = status == Status.OK
    odd = np.where(ok, uneven.astype(np.float64) ** 2 - sigma.astype(np.float64) ** 2, 0)
    change = np.zeros(len(centre))
    if ok.any():
        lag = max(1, round(2**0.5 * float(np.median(width[ok]))))
        logarithm = np.log(np.where(ok, np.maximum(level, 1e-12), 1).astype(np.float64))
        pair = np.zeros(len(centre))
        known = np.zeros(len(centre))
        both = ok[:-lag] & ok[lag:] & (np.abs(centre[lag:] - centre[:-lag]) <= SAME_CURVE_PX * lag)
        floor = noise**2 / (2 * np.pi**0.5 * np.maximum(width, 0.5))  # variance of the level: that of a mean under a Gaussian window
        relative = floor / np.where(ok, np.maximum(level, 1e-12), 1).astype(np.float64) ** 2
        step = np.where(both, (logarithm[lag:] - logarithm[:-lag]) ** 2 - relative[lag:] - relative[:-lag], 0)
        pair[:-lag] += step
        pair[lag:] += step
        known[:-lag] += both
        known[lag:] += both
        change = np.where(even > 0, 0, 0.5 * width.astype(np.float64) ** 2
                          * _beside(pair, FURTHER_LINES) / np.maximum(_beside(known, FURTHER_LINES), 1e-9))
    around = _beside(odd, BESIDE_LINES) / np.maximum(_beside(ok.astype(float), BESIDE_LINES), 1e-9)
    alone = np.where(odd > CUT**2 * sigma.astype(np.float64) ** 2, odd, 0)  # the edge of a surface cuts the stripe of this line
    usual = float(np.median(width[ok])) if ok.any() else 0.0
    cut = CUT_SHIFT * np.where(ok, np.maximum(NARROW * usual - width, 0), 0)
    texture = np.maximum.reduce([around, alone, change, cut**2])
    return np.sqrt(sigma.astype(np.float64) ** 2 + texture)


def _beside(values: np.ndarray, lines: int) -> np.ndarray:
    """Return the mean over so many lines on either side of each line; beyond the image values count as 0."""
    return np.convolve(values, np.full(2 * lines + 1, 1 / (2 * lines + 1)), mode="full")[lines:lines + len(values)]


# How far the planes of a sweep may be off: how depths change with them, and whether another sweep confirms them.
#
# One sweep gives a surface as smooth as the true one under planes that are all off by one frame, or turned alike; nothing in it tells them.
# Stripes across the rows and stripes across the columns see the same surfaces, and do.

def depth_per_turn(x: np.ndarray, y: np.ndarray, depth: np.ndarray, laser: LaserPlane) -> np.ndarray:
    """Return the change of the depths of points on a plane for each radian by which it turns, metres, for the axis that makes most of it.

    A plane whose place is declared to be known at its point turns about that, others about the point nearest to the camera, where the
    laser is about.
    """
    point = np.array(laser.point_m)
    if laser.accuracy_m is None:
        normal = np.array(laser.normal) / np.linalg.norm(laser.normal)
        point = normal * (point @ normal)
    away = np.stack([x * depth, y * depth, -depth], axis=-1) - point
    return np.asarray(np.linalg.norm(away, axis=-1) * _depth_per_shift(x, y, laser))


def _depth_per_shift(x: np.ndarray, y: np.ndarray, laser: LaserPlane) -> np.ndarray:
    """Return the change of the depths of points on a plane for each metre by which it moves along its normal."""
    normal = np.array(laser.normal) / np.linalg.norm(laser.normal)
    with np.errstate(divide="ignore"):
        return np.asarray(1 / np.abs(x * normal[0] + y * normal[1] - normal[2]))


def unconfirmed(samples: Sequence[StripeSamples], planes: Sequence[LaserPlane], camera: Camera, *, along: str) -> str | None:
    """Return a sentence about planes whose accuracy nobody declares: what one sweep does not tell, and what it would make.
    `samples`: the samples of each frame whose stripe crosses the same lines; their depth is 0 where there is none. `planes`: the plane
    of each of these frames, in the same order."""
    turned, moved = [], []
    for index, (part, plane) in enumerate(zip(samples, planes, strict=True)):
        other = planes[index + 1 if index + 1 < len(planes) else index - 1]
        shown = part.where(part.depth > 0)
        turned.append(np.radians(1) * depth_per_turn(*shown.rays(camera, along=along), shown.depth, plane))
        moved.append(shown.depth_change(other, camera, along=along))
    if not turned or not np.isfinite(np.concatenate(turned)).any():
        return None
    degree, one_frame, aside = 1000 * float(np.nanmedian(np.concatenate(turned))), np.concatenate(moved), ""
    if len(planes) > 1 and np.isfinite(one_frame).any():
        aside = f", or by {1000 * float(np.nanmedian(one_frame)):.3g} mm if all are off by one frame"
    return (f"frames[].laser: one sweep does not tell whether its planes are right: depths are off by {degree:.3g} mm for each degree "
            f"that all are turned by{aside}, and the standard deviations hold the light alone: give accuracy_deg, which they then hold, "
            "or sweep planes across the other axis too")


def compare_sweeps(rows: StripeMap, columns: StripeMap) -> tuple[float, float] | None:
    """Return the median difference of the depths of two sweeps, metres, and in their deviations; None if they share too few pixels."""
    both = rows.solved & columns.solved
    if both.sum() < ENOUGH:
        return None
    away = np.abs(rows.depth[both].astype(np.float64) - columns.depth[both])
    return float(np.median(away)), float(np.median(away / np.maximum(np.hypot(rows.sigma[both], columns.sigma[both]), 1e-12)))
