"""Sub-stripe coordinates from a Gray code with inverses: between two edges, found to a part of a camera pixel, u is interpolated.

An edge lies between two neighbouring pixels whose stripes are neighbours too. One bit changes there, and its difference
d = I - Ī changes sign: where it would be zero, linearly between the two pixels, is the edge, whatever their albedo and whatever the
blur. A pixel with an edge on either side, one stripe apart, takes its place between them; every other pixel keeps its stripe.

Where pixels see less of the surface than they are apart (in the limit points, as in images that are rendered or shrunk without
filtering), an edge may pass between two of them unseen, and lies anywhere there. How wide they see is told by how often neither pixel
of an edge sees a part of either stripe.

Source: Trobina, "Error model of a coded-light range sensor", BIWI technical report 164, ETH Zürich 1995 (crossing of a pattern and
its inverse).
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.device import once
from kernels.errors import ArrayError
from kernels.packs import Band, as_packs, as_pixels, pack_type, unwritten
from kernels.status import OK
from kernels.structured.binary import gray_to_binary
from kernels.structured.decoded import Decoded
from kernels.structured.pattern_frames import NoiseModel, check_noise, check_stripes, require_frames

REACH = 48
"""Distance in camera pixels within which an edge is searched on either side; a wider stripe is not interpolated."""
EDGE_ERROR = 0.065
"""RMS error, in camera pixels, of an edge found by linear interpolation where a pixel sees a sharp square of the surface; blur makes it
smaller. Both edges of a stripe count with the same error, as they have where stripes are a whole number of pixels wide."""
UNSEEN_ERROR = 12**-0.5
"""The same where pixels see points: edges lie anywhere between two of them."""
WHOLE = 0.8
"""Part of the difference between white and black from which on a pixel is taken to see one stripe alone. Of edges on sharp squares both
pixels do so at 1 - WHOLE of them; on squares of a part w of that width at 1 - WHOLE w, where the RMS error is w EDGE_ERROR + (1 - w)
UNSEEN_ERROR to a hundredth of a pixel."""


def edge_error_of(whole: float) -> float:
    """Return the RMS error in camera pixels of edges found by linear interpolation.
    `whole`: part of the edges at which both pixels see one stripe alone, to WHOLE of it."""
    width = min((1 - whole) / WHOLE, 1.0)
    return width * EDGE_ERROR + (1 - width) * UNSEEN_ERROR


def refine_edges(decoded: Decoded, frames: Band, bits: Sequence[int], inverses: Sequence[int], *, columns: int, down: bool,
                 extent: float, stripe_px: float = 1.0, noise: NoiseModel, edge_error: float = EDGE_ERROR) -> Decoded:
    """Interpolate a decoded Gray code between the edges of its stripes; not synchronised on CUDA.

    Args:
        decoded: of decode_gray from these frames.
        frames: whole rows of an image, linear, one channel.
        bits: frame of each bit, bit 0 (the finest) first.
        inverses: frame of each inverse in the same order.
        columns: pixels of an image row.
        down: whether the coordinate changes from row to row (a row code) rather than along a row.
        extent: projector pixels along the axis.
        stripe_px: width of the finest stripe.
        edge_error: RMS error of an edge between two pixels without noise, camera pixels, as of `edge_error_of`.

    Raises:
        ArrayError: no inverses, or pixels that are not whole rows or not those decoded.
    """
    check_noise(noise)
    check_stripes(extent, stripe_px)
    require_frames(frames, *bits, *inverses)
    if not bits or len(inverses) != len(bits):
        raise ArrayError(f"there are {len(bits)} bits and {len(inverses)} inverses: edges are found with one for each")
    if columns < 1 or frames.pixel_count % columns:
        raise ArrayError(f"{frames.pixel_count} pixels are not whole rows of {columns}: give the image's width")
    if decoded.coordinate.shape[0] != frames.packs * devices.pack_width(frames.device):
        raise ArrayError(f"the code has {decoded.coordinate.shape[0]} pixels, the frames {frames.pixel_count}: decode the same frames")
    device = frames.device
    number = unwritten(frames.pixel_count, wp.int32, device)
    rows = wp.array(np.stack([bits, inverses], axis=1), dtype=wp.int32, device=device)
    devices.launch(_number_kernel(devices.pack_width(device)), frames.packs, [frames.values, rows], [as_packs(number, device)],
                   device=device)
    coordinate, sigma = (wp.clone(array) for array in decoded[:2])
    devices.launch(_edge_kernel, frames.pixel_count,
                   [as_pixels(frames.values), rows, number, decoded.status, columns, frames.pixel_count // columns, 1 if down else 0,
                    float(stripe_px), float(extent), noise.read**2, noise.gain, edge_error], [coordinate, sigma],
                   device=device, uneven=True)
    return Decoded(coordinate, sigma, decoded.amplitude, decoded.status)


@wp.struct
class Edge:
    """The end of the stripe of a pixel."""

    found: int
    at: float  # camera pixels from the pixel, unsigned
    variance: float  # of that, pixels²
    place: float  # projector coordinate


@wp.func
def find_edge(readings: wp.array2d(dtype=float), rows: wp.array2d(dtype=int), number: wp.array(dtype=int), status: wp.array(dtype=wp.uint8),
              pixel: int, step: int, room: int, stripe: float, read_variance: float, gain: float) -> Edge:
    """Return the first edge from a pixel in one direction; none where decoded pixels end or stripes are not neighbours."""
    edge = Edge()
    here = pixel
    for away in range(room):
        there = here + step
        if int(status[there]) != OK:
            break
        if number[there] != number[here]:
            if wp.abs(number[there] - number[here]) == 1:
                changed = (number[here] ^ (number[here] >> 1)) ^ (number[there] ^ (number[there] >> 1))
                bit = int(0)  # noqa: RUF046 - declares a variable that a Warp loop may change
                while (changed >> (bit + 1)) != 0:
                    bit = bit + 1
                one = readings[rows[bit, 0], here]
                other = readings[rows[bit, 1], here]
                next_one = readings[rows[bit, 0], there]
                next_other = readings[rows[bit, 1], there]
                a, b = one - other, next_one - next_other
                span = a - b
                t = a / span
                variance_a = 2.0 * read_variance + gain * wp.max(one + other, 0.0)
                variance_b = 2.0 * read_variance + gain * wp.max(next_one + next_other, 0.0)
                edge.found = 1
                edge.at = float(away) + t
                edge.variance = (b * b * variance_a + a * a * variance_b) / (span * span * span * span)
                edge.place = float(wp.max(number[here], number[there])) * stripe
            break
        here = there
    return edge


@once
def _number_kernel(pack: int) -> Any:
    float_pack, int_pack = pack_type(pack, wp.float32), pack_type(pack, wp.int32)

    @wp.kernel(enable_backward=False, module="unique")
    def number_kernel(first: int,
                      values: wp.array2d(dtype=float_pack),  # [F, P]
                      rows: wp.array2d(dtype=int),  # [bits, 2] frame, inverse
                      # outputs
                      number: wp.array(dtype=int_pack)):  # [P] stripe by the signs of all bits
        p = first + wp.tid()
        shown = int_pack()
        for bit in range(rows.shape[0]):
            flag = 1 << bit
            one = values[rows[bit, 0], p]
            other = values[rows[bit, 1], p]
            for k in range(pack):
                shown[k] = shown[k] + wp.where(one[k] > other[k], flag, 0)
        for k in range(pack):
            shown[k] = gray_to_binary(shown[k])
        number[p] = shown

    return number_kernel


@wp.kernel(enable_backward=False, module="unique")
def _edge_kernel(first: int,
                 readings: wp.array2d(dtype=float),  # [F, pixels]
                 rows: wp.array2d(dtype=int),  # [bits, 2] frame, inverse
                 number: wp.array(dtype=int),  # [pixels] stripe by the signs of all bits
                 status: wp.array(dtype=wp.uint8),  # [pixels]
                 columns: int,
                 lines: int,
                 down: int,
                 stripe: float,
                 extent: float,
                 read_variance: float,
                 gain: float,
                 error: float,
                 # outputs
                 coordinate: wp.array(dtype=float),  # in: stripe centres
                 sigma: wp.array(dtype=float)):
    p = first + wp.tid()
    if int(status[p]) != OK:
        return
    column = p % columns
    line = p / columns
    step = wp.where(down == 1, columns, 1)
    before = wp.min(wp.where(down == 1, line, column), REACH)
    after = wp.min(wp.where(down == 1, lines - 1 - line, columns - 1 - column), REACH)
    low = find_edge(readings, rows, number, status, p, -step, before, stripe, read_variance, gain)
    high = find_edge(readings, rows, number, status, p, step, after, stripe, read_variance, gain)
    if low.found == 0 or high.found == 0 or low.place == high.place:
        return
    length = low.at + high.at
    slope = (high.place - low.place) / length
    share = low.at / length
    u = low.place + slope * low.at
    noise_variance = (1.0 - share) * (1.0 - share) * low.variance + share * share * high.variance
    deviation = wp.abs(slope) * wp.sqrt(noise_variance + error * error)
    if u > 0.0 and u < extent and deviation < sigma[p]:  # not NaN, and better than the stripe alone
        coordinate[p] = u
        sigma[p] = deviation
