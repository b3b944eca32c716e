"""Doubtful stripes that the surface around them confirms, as on the black squares of a chessboard.

On dark surfaces noise and the halo of bright ones around leave bits in doubt, though most of these pixels are read rightly: a wrong bit
would place them many stripes away. A plane is fitted to the coordinates of the sure pixels around a doubtful one, which lie on all four
sides of it; where the pixel as read lies within the error of that plane, and the finest bits show direct light, it counts as decoded.
The coordinate stays as it was read; what neighbours and reading differ by is in its deviation. Nothing is filled in: a pixel that
reads anything else stays in doubt.
"""

from collections.abc import Sequence

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.errors import ArrayError
from kernels.packs import Band, as_pixels
from kernels.status import OK, Status
from kernels.structured.binary import FINE_BITS
from kernels.structured.decoded import STRIPE_DEVIATION, Decoded
from kernels.structured.pattern_frames import NoiseModel, check_noise, check_stripes, require_frames

AROUND = 9
"""Distance in camera pixels up to which sure pixels count."""
LEAST_SIDE = 4
"""Least number of sure pixels on each of the four sides: the plane is only read between them, never beyond."""
LARGEST_RMS = 1.5
"""Largest RMS distance of the sure pixels from their plane, in stripes: more is no plane, but an edge of depth."""
SLACK, SLACK_RMS = 2.0, 2.0
"""Largest distance of a confirmed pixel from the plane: so many stripes and so many RMS distances of the sure pixels. Two stripes
are what the two finest bits tell, which noise may turn."""
LEAST_DIRECT = 0.2
"""Least share of the contrast that two of the three finest bits must show: light of other ways, as the halo of a lens, hardly follows
them."""
DIRECT_SIGMAS = 2.0
"""Least of the same in standard deviations of a bit's difference."""

_UNDECIDED, _MULTIPATH = int(Status.UNDECIDED), int(Status.MULTIPATH)


def confirm_stripes(decoded: Decoded, frames: Band, bits: Sequence[int], inverses: Sequence[int], *, columns: int, stripe_px: float = 1.0,
                    noise: NoiseModel) -> Decoded:
    """Decide doubtful pixels of a code with inverses whose reading agrees with the surface around them; not synchronised on CUDA.

    UNDECIDED and MULTIPATH pixels that are confirmed become OK with a deviation of their own; coordinate and amplitude are those given.

    Args:
        decoded: of a binary, Gray or XOR code of three bits or more from these frames.
        frames: whole rows of an image, linear, one channel.
        bits: frame of each bit, bit 0 (the finest) first.
        inverses: frame of each inverse in the same order.
        columns: pixels of an image row.
        stripe_px: width of the finest stripe.

    Raises:
        ArrayError: no inverses, too few bits, or pixels that are not whole rows or not those decoded.
    """
    check_noise(noise)
    check_stripes(1.0, stripe_px)
    require_frames(frames, *bits, *inverses)
    if len(bits) < FINE_BITS or len(inverses) != len(bits):
        raise ArrayError(f"there are {len(bits)} bits and {len(inverses)} inverses: stripes are confirmed with three bits and more, and as "
                         "many inverses")
    if columns < 1 or frames.pixel_count % columns:
        raise ArrayError(f"{frames.pixel_count} pixels are not whole rows of {columns}: give the image's width")
    if decoded.coordinate.shape[0] != frames.packs * devices.pack_width(frames.device):
        raise ArrayError(f"the code has {decoded.coordinate.shape[0]} pixels, the frames {frames.pixel_count}: decode the same frames")
    device = frames.device
    sigma, status = wp.clone(decoded.sigma), wp.clone(decoded.status)
    rows = wp.array(np.stack([bits, inverses], axis=1), dtype=wp.int32, device=device)
    devices.launch(_confirm_kernel, frames.pixel_count,
                   [as_pixels(frames.values), rows, decoded.coordinate, decoded.sigma, decoded.status, columns,
                    frames.pixel_count // columns, float(stripe_px), noise.read**2, noise.gain], [sigma, status],
                   device=device, uneven=True)
    return Decoded(decoded.coordinate, sigma, decoded.amplitude, status)


@wp.struct
class Plane:
    """The plane of sure pixels around a pixel."""

    found: int
    offset: float  # projector pixels from the pixel as read to the plane
    rms: float  # projector pixels


@wp.func
def shows_direct_light(readings: wp.array2d(dtype=float), rows: wp.array2d(dtype=int), row: int, column: int, lines: int, columns: int,
                       read_variance: float, gain: float) -> bool:
    """Return whether two of the three finest bits follow the projector, on average over the pixel and its eight neighbours.

    They must stand out of the largest difference of a bit and out of noise.
    """
    whole = float(0.0)
    direct = float(0.0)
    variance = float(0.0)
    count = float(0.0)
    for line in range(wp.max(row - 1, 0), wp.min(row + 2, lines)):
        for place in range(wp.max(column - 1, 0), wp.min(column + 2, columns)):
            pixel = line * columns + place
            contrast = float(0.0)
            before = float(0.0)
            pair = float(0.0)
            for bit in range(rows.shape[0]):
                one = readings[rows[bit, 0], pixel]
                other = readings[rows[bit, 1], pixel]
                d = wp.abs(one - other)
                contrast = wp.max(contrast, d)
                if bit < wp.static(FINE_BITS):
                    if bit > 0:
                        pair = wp.max(pair, 0.5 * (before + d))
                    before = d
                    variance += (2.0 * read_variance + gain * wp.max(one + other, 0.0)) / wp.static(float(FINE_BITS))
            whole += contrast
            direct += pair
            count += 1.0
    return direct >= LEAST_DIRECT * whole and direct >= DIRECT_SIGMAS * wp.sqrt(variance * count)


@wp.func
def fit_plane(coordinate: wp.array(dtype=float), status: wp.array(dtype=wp.uint8), row: int, column: int, lines: int, columns: int,
              here: float) -> Plane:
    """Return the least-squares plane of the sure pixels around a pixel, which is found where they lie on all four sides of it."""
    count = float(0.0)
    sx = float(0.0)
    sy = float(0.0)
    sxx = float(0.0)
    sxy = float(0.0)
    syy = float(0.0)
    su = float(0.0)
    sxu = float(0.0)
    syu = float(0.0)
    suu = float(0.0)
    left = int(0)  # noqa: RUF046
    right = int(0)  # noqa: RUF046
    above = int(0)  # noqa: RUF046
    below = int(0)  # noqa: RUF046
    for line in range(wp.max(row - AROUND, 0), wp.min(row + AROUND + 1, lines)):
        for place in range(wp.max(column - AROUND, 0), wp.min(column + AROUND + 1, columns)):
            other = line * columns + place
            if int(status[other]) == OK:
                x = float(place - column)
                y = float(line - row)
                u = coordinate[other] - here
                count += 1.0
                sx += x
                sy += y
                sxx += x * x
                sxy += x * y
                syy += y * y
                su += u
                sxu += x * u
                syu += y * u
                suu += u * u
                left += wp.where(place < column, 1, 0)
                right += wp.where(place > column, 1, 0)
                above += wp.where(line < row, 1, 0)
                below += wp.where(line > row, 1, 0)
    plane = Plane()
    if wp.min(wp.min(left, right), wp.min(above, below)) < LEAST_SIDE:
        return plane
    mx = sx / count
    my = sy / count
    mu = su / count
    cxx = sxx - sx * mx
    cxy = sxy - sx * my
    cyy = syy - sy * my
    cxu = sxu - sx * mu
    cyu = syu - sy * mu
    cuu = suu - su * mu
    whole = cxx * cyy - cxy * cxy
    if whole <= 1.0e-3 * cxx * cyy:  # they lie on a line
        return plane
    a = (cxu * cyy - cyu * cxy) / whole
    b = (cyu * cxx - cxu * cxy) / whole
    plane.found = 1
    plane.offset = mu - a * mx - b * my
    plane.rms = wp.sqrt(wp.max(cuu - a * cxu - b * cyu, 0.0) / (count - 3.0))
    return plane


@wp.kernel(enable_backward=False, module="unique")
def _confirm_kernel(first: int,
                    readings: wp.array2d(dtype=float),  # [F, pixels]
                    rows: wp.array2d(dtype=int),  # [bits, 2] frame, inverse
                    coordinate: wp.array(dtype=float),  # [pixels]
                    deviation: wp.array(dtype=float),  # [pixels] as decoded
                    state: wp.array(dtype=wp.uint8),  # [pixels] as decoded
                    columns: int,
                    lines: int,
                    stripe: float,
                    read_variance: float,
                    gain: float,
                    # outputs
                    sigma: wp.array(dtype=float),
                    status: wp.array(dtype=wp.uint8)):
    p = first + wp.tid()
    code = int(state[p])
    if (code != _UNDECIDED and code != _MULTIPATH) or deviation[p] <= 0.0:
        return
    row = p / columns
    column = p % columns
    if not shows_direct_light(readings, rows, row, column, lines, columns, read_variance, gain):
        return
    plane = fit_plane(coordinate, state, row, column, lines, columns, coordinate[p])
    if plane.found == 0 or plane.rms > LARGEST_RMS * stripe:
        return
    away = wp.abs(plane.offset)
    if away <= SLACK * stripe + SLACK_RMS * plane.rms:
        sigma[p] = wp.sqrt(away * away + plane.rms * plane.rms + wp.static(STRIPE_DEVIATION**2) * stripe * stripe)
        status[p] = wp.uint8(OK)
