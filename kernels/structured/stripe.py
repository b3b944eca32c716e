"""Light striping: the sub-pixel centre of a laser stripe along each line of the image, and where its plane meets the line of sight.

First the peak of the line after a short smoothing, which a hot pixel does not win, and the width of the pixels that hang together with
it. Then the centre: the peak of the line smoothed by a Gaussian of the stripe's own width, which is where the centre of mass under
that Gaussian is the Gaussian's middle. Unlike a centre of mass over whole pixels above a threshold it has no cut edges, which would
pull it by hundredths of a pixel: at 1.4 m a tenth of a millimetre.

Texture bends the profile: a pixel of twice the albedo pulls the centre towards it. Where the albedo of the pixels is known, the profile is
divided by it. What is left over on one side of the centre and not on the other is no stripe's shape, and adds to the deviation: the odd
residual of each pixel is taken for an error of its own (White's estimate of variance).
"""

from typing import NamedTuple

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.errors import ArrayError
from kernels.status import OK, Status

LEVEL = 0.2
"""Part of the peak above which a pixel counts towards the stripe's width."""
MIN_WINDOW_PX = 1.5
"""Least standard deviation of the Gaussian window, pixels: whole pixels do not sample a narrower one well."""
REACH = 4.0
"""Half-width of the Gaussian window in standard deviations: 6e-5 of the Gaussian lies outside."""
STEPS = 8
"""Number of Newton steps; a Gaussian profile takes one, a saturated one about four."""
NOISE_FACTOR = 6.0
"""Least height of a stripe, in standard deviations of the noise."""
MAX_WIDTH_PX = 96
"""Half the length of the longest run of pixels that counts as one stripe: a broader run is a lit area."""
LEAST_GAIN = 0.1
"""Least slope of Newton's step, 1 - variance under the window / variance of the window, that is divided by: a Gaussian stripe has 0.5."""
RIVAL = 0.7
"""Part of the peak from which a second bright place on the line makes the stripe undecided, unless another part is given."""
KNOWN_REACH = 2.5
"""Standard deviations of the stripe to both sides within which the albedo of all pixels must be known for a division: beyond, profile and
window together fall to a five-hundredth."""
MOST_SHARED = 0.75
"""Largest part of the variance of a reading that cancels when it is divided by the root of the energy that it is part of."""
ODD_SHARE = 0.72
"""Part of the noise that odd residuals show: they are halves of differences, interpolated between pixels, of a profile that was fitted to
the centre."""
GRAZING = 0.02
"""Least sine of the angle between a line of sight and the plane of light, 1.1 degrees: at less, where they meet is too uncertain."""

_LOW, _UNDECIDED = int(Status.LOW_MODULATION), int(Status.UNDECIDED)


class Stripe(NamedTuple):
    """One stripe: a place on each line of the image."""

    centre: wp.array  # [lines] float32, continuous coordinate along the line; 0 where there is none
    sigma: wp.array  # [lines] float32, pixels, from the noise
    uneven: wp.array  # [lines] float32, pixels: the deviation that odd residuals of the profile show, noise included
    width: wp.array  # [lines] float32, pixels: standard deviation of the stripe's profile
    level: wp.array  # [lines] float32: mean of the signal under the window of the stripe, in the unit of the image
    even: wp.array  # [lines] uint8: 1 where the profile was divided by the albedo
    amplitude: wp.array  # [lines] float32, peak in the unit of the image
    status: wp.array  # [lines] uint8: OK, LOW_MODULATION: nothing stands out, UNDECIDED: as bright elsewhere, too broad, or cut


class PlaneMeeting(NamedTuple):
    """The points in which lines of sight meet a plane."""

    depth: np.ndarray  # [n] metres, NaN where they do not in front of the camera
    per_pixel: np.ndarray  # [n] metres of depth for one unit along each line's x or y, whichever was asked for


def find_stripe(signal: np.ndarray, *, along: str, noise: float, device: str, albedo: np.ndarray | None = None,
                rival: float = RIVAL) -> Stripe:
    """Find the stripe's centre on each row or column; not synchronised on CUDA.

    Args:
        signal: [rows, cols] float32, the frame less its background; 0 where it is not to be looked at.
        along: "row": one centre a row, a u; "column": one a column, a v.
        noise: standard deviation of the signal where there is no stripe.
        albedo: [rows, cols] float32, the root of the energy Σ signal² of each pixel over a sweep that this frame is part of, in
            proportion to its albedo; 0 where it is not known; None: nowhere.
        rival: part of the peak from which a second bright place on the line makes the stripe UNDECIDED; inf: it never does.

    Source:
        Steger, "An unbiased detector of curvilinear structures", TPAMI 1998, section 2: the peak of the smoothed profile; the step is
        the mean shift of Comaniciu and Meer, TPAMI 2002, equation 20, divided by its slope; White, "A heteroskedasticity-consistent
        covariance matrix estimator", Econometrica 48, 1980 (odd residuals).
    """
    if along not in ("row", "column"):
        raise ArrayError(f"along is {along}: give row or column")
    if signal.ndim != 2:
        raise ArrayError(f"signal is {signal.ndim}-dimensional: give [rows, cols]")
    lines, length = signal.shape if along == "row" else signal.shape[::-1]
    image = wp.array(np.ascontiguousarray(signal, dtype=np.float32).reshape(-1), dtype=wp.float32, device=device)
    steps = (signal.shape[1], 1) if along == "row" else (1, signal.shape[1])
    known = albedo if albedo is not None else np.zeros((1, 1), np.float32)
    inverse = np.divide(1.0, known, out=np.zeros(known.shape, np.float32), where=known > 0)
    found = Stripe(*(wp.zeros(lines, dtype=wp.float32, device=device) for _ in range(5)), wp.zeros(lines, dtype=wp.uint8, device=device),
                   wp.zeros(lines, dtype=wp.float32, device=device), wp.zeros(lines, dtype=wp.uint8, device=device))
    devices.launch(_stripe_kernel, lines, [
        image, wp.array(np.ascontiguousarray(inverse).reshape(-1), dtype=wp.float32, device=device), int(length), *map(int, steps),
        float(NOISE_FACTOR * noise), float(noise), float(rival)], list(found), device=device)
    return found


@wp.func
def residual(image: wp.array(dtype=wp.float32), inverse: wp.array(dtype=wp.float32), even: bool, at: int, off: float, height: float,
             width: float):
    """Return what a pixel's profile, divided by its albedo, is above a Gaussian of this height and width."""
    value = image[at]
    if even:
        value *= inverse[at]
    return value - height * wp.exp(-0.5 * off * off / (width * width))


@wp.kernel(enable_backward=False)
def _stripe_kernel(first: int,
                   image: wp.array(dtype=wp.float32),  # [pixels]
                   inverse: wp.array(dtype=wp.float32),  # [pixels] 1 / albedo, 0 where it is not known; or one 0
                   length: int,
                   line_step: int,
                   step: int,
                   least: float,
                   noise: float,
                   part: float,
                   # outputs
                   centre: wp.array(dtype=wp.float32),  # [lines]
                   sigma: wp.array(dtype=wp.float32),  # [lines]
                   uneven: wp.array(dtype=wp.float32),  # [lines]
                   spread: wp.array(dtype=wp.float32),  # [lines]
                   mean_level: wp.array(dtype=wp.float32),  # [lines]
                   divided: wp.array(dtype=wp.uint8),  # [lines]
                   amplitude: wp.array(dtype=wp.float32),  # [lines]
                   status: wp.array(dtype=wp.uint8)):  # [lines]
    line = first + wp.tid()
    start = line * line_step
    # peak of three neighbours' mean
    best, place = float(-1.0e30), wp.int32(0)
    before, here = float(0.0), float(image[start])
    for i in range(length):
        after = float(0.0)
        if i + 1 < length:
            after = image[start + (i + 1) * step]
        mean = before + 2.0 * here + after
        if mean > best:
            best = mean
            place = i
        before = here
        here = after
    peak = float(image[start + place * step])
    for side in range(2):
        other = place + 2 * side - 1
        if other >= 0 and other < length:
            peak = wp.max(peak, image[start + other * step])
    if best / 4.0 < least / 2.0 or peak < least:
        status[line] = wp.uint8(_LOW)
        return
    floor = wp.max(LEVEL * peak, 2.0 * noise)
    left, right = wp.int32(place), wp.int32(place)
    while left > 0 and place - left < MAX_WIDTH_PX and image[start + (left - 1) * step] > floor:
        left -= 1
    while right < length - 1 and right - place < MAX_WIDTH_PX and image[start + (right + 1) * step] > floor:
        right += 1
    amplitude[line] = peak
    if right - place >= MAX_WIDTH_PX or place - left >= MAX_WIDTH_PX:
        status[line] = wp.uint8(_UNDECIDED)
        return
    # another place that is as bright is a second stripe: a reflection, or the other side of a step
    rival = float(0.0)
    for i in range(length):
        if i < left - 1 or i > right + 1:
            rival = wp.max(rival, image[start + i * step])
    total, moment, square = float(0.0), float(0.0), float(0.0)
    for i in range(left, right + 1):
        weight = image[start + i * step] - floor
        off = float(i - place)
        total += weight
        moment += weight * off
        square += weight * off * off
    middle = moment / total
    width = wp.max(wp.sqrt(wp.max(square / total - middle * middle, 0.0)), MIN_WINDOW_PX)
    if float(place) + middle < width or float(place) + middle > float(length - 1) - width:
        status[line] = wp.uint8(_UNDECIDED)  # the border of the image cuts it
        return
    even = inverse.shape[0] == image.shape[0]
    if even:
        near = wp.int32(wp.floor(float(place) + middle - KNOWN_REACH * width))
        far = wp.int32(wp.ceil(float(place) + middle + KNOWN_REACH * width))
        even = near >= 0 and far < length
        for i in range(wp.max(near, 0), wp.min(far, length - 1) + 1):
            if inverse[start + i * step] <= 0.0:
                even = False
    error, gain, low, high = float(0.0), float(1.0), wp.int32(0), wp.int32(0)
    sum0, sum1, sum2, raw, under = float(0.0), float(0.0), float(0.0), float(0.0), float(0.0)
    for _newton in range(STEPS):
        low = wp.max(int(wp.ceil(float(place) + middle - REACH * width)), 0)
        high = wp.min(int(wp.floor(float(place) + middle + REACH * width)), length - 1)
        noise2 = float(0.0)
        sum0 = float(0.0)
        sum1 = float(0.0)
        sum2 = float(0.0)
        raw = float(0.0)
        under = float(0.0)
        for i in range(low, high + 1):
            off = float(i - place) - middle
            window = wp.exp(-0.5 * off * off / (width * width))
            raw += window * image[start + i * step]
            under += window
            shared = float(1.0)
            if even:
                window *= inverse[start + i * step]
                # the frame's own noise is in its pixel's energy too: what both share cancels
                part_of_energy = image[start + i * step] * inverse[start + i * step]
                shared -= wp.min(part_of_energy * part_of_energy, MOST_SHARED)
            weight = window * image[start + i * step]
            sum0 += weight
            sum1 += weight * off
            sum2 += weight * off * off
            noise2 += shared * window * window * off * off
        if sum0 <= 0.0:
            status[line] = wp.uint8(_LOW)
            return
        off = sum1 / sum0
        gain = wp.max(1.0 - (sum2 / sum0 - off * off) / (width * width), LEAST_GAIN)
        middle += wp.clamp(off / gain, -width, width)
        error = noise * wp.sqrt(noise2) / (sum0 * gain)
    # residuals from the Gaussian with the same moments under the window, less those mirrored in the centre
    variance = wp.max(sum2 / sum0, 0.01)
    own = 1.0 / wp.max(wp.sqrt(wp.max(1.0 / variance - 1.0 / (width * width), 0.0)), 1.0 / float(MAX_WIDTH_PX))
    total = float(0.0)
    for i in range(low, high + 1):
        off = float(i - place) - middle
        total += wp.exp(-0.5 * off * off * (1.0 / (width * width) + 1.0 / (own * own)))
    height = sum0 / total
    odd2 = float(0.0)
    for i in range(low, high + 1):
        off = float(i - place) - middle
        mirrored = float(place) + middle - off
        floor_place = wp.int32(wp.floor(mirrored))
        if floor_place >= 0 and floor_place + 1 < length:
            fraction = mirrored - float(floor_place)
            here = residual(image, inverse, even, start + i * step, off, height, own)
            first_pixel = start + floor_place * step
            there = residual(image, inverse, even, first_pixel, float(floor_place - place) - middle, height, own)
            after = residual(image, inverse, even, first_pixel + step, float(floor_place + 1 - place) - middle, height, own)
            there += fraction * (after - there)
            odd = 0.5 * (here - there) * off * wp.exp(-0.5 * off * off / (width * width))
            odd2 += odd * odd
    centre[line] = float(place) + middle + 0.5
    sigma[line] = error
    uneven[line] = wp.sqrt(2.0 * odd2) / (ODD_SHARE * sum0 * gain)
    spread[line] = own
    mean_level[line] = raw / under
    divided[line] = wp.uint8(wp.where(even, 1, 0))
    status[line] = wp.uint8(wp.where(rival > part * peak, _UNDECIDED, OK))


def plane_depths(x: np.ndarray, y: np.ndarray, point: np.ndarray, normal: np.ndarray, *, along: str) -> PlaneMeeting:
    """Return the depth at which lines of sight (x, y, -1) through the camera's centre meet a plane of light.

    It is NaN where the line meets the plane behind the camera, or at less than 1.1 degrees.
    `x, y`: [n] float64. `point`: [3] on the plane, metres, camera frame. normal: [3] of the plane, unit. `along`: "row" or "column":
    whether `per_pixel` is for x or for y."""
    normal = np.asarray(normal, float)
    facing = x * normal[0] + y * normal[1] - normal[2]
    sine = np.abs(facing) / np.sqrt(x * x + y * y + 1)
    distance = float(np.dot(point, normal))
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = np.where(sine > GRAZING, distance / facing, np.nan)
    depth = np.where(depth > 0, depth, np.nan)
    return PlaneMeeting(depth, np.abs(depth * normal[0 if along == "row" else 1] / np.where(facing == 0, np.nan, facing)))
