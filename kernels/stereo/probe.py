"""The disparities that a scene has, from few places that are compared with all columns of the other image.

Without a range of depths nothing says which disparities semi-global matching has to consider. Every few pixels one place is compared with
its whole row, in both directions: what is unique there bounds the disparities, and tells when the two images are swapped.
"""

from typing import Any, NamedTuple

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.device import once
from kernels.packs import new_array, pack_type
from kernels.stereo.choice import APART, SPREAD
from kernels.stereo.cost import CHANCE, SCALE, Labels, census_pair, sliding
from kernels.stereo.paths import FAR


class Probe(NamedTuple):
    """The best disparity of each sampled place."""

    label: wp.array  # [rows, cols] int32 of `Labels`, over the grid of samples
    lead: wp.array  # [rows, cols] float32, by how much the best rival fits worse, relative to chance


def probe(
    left: np.ndarray,  # [frames, rows, cols] float32, rectified
    right: np.ndarray,  # [frames, rows, right cols] float32
    seen: np.ndarray,  # [rows, right cols] bool, False where the right camera sees nothing
    labels: Labels,  # the disparities that are compared
    *,
    step: int,  # distance between sampled places, in rows and columns; the first lies half a step from the corner
    device: str,
) -> Probe:
    """Compare some places of the left image with whole rows of the right one. Returns arrays on the device, not synchronised on CUDA."""
    frames, rows, cols = left.shape
    bits = census_pair(left, right, seen, labels, device=device)
    shape = max(1, rows // step), max(1, cols // step)
    found = Probe(new_array(shape, wp.int32, device, cleared=True), new_array(shape, wp.float32, device, cleared=True))
    pack = devices.pack_width(device)
    devices.launch(_probe_kernel(pack), shape[0] * shape[1],
                   [bits.left, sliding(bits.right), sliding(bits.seen), rows, cols, labels.packs, bits.start, step, SCALE / frames],
                   list(found), device=device)
    return found


@once
def _probe_kernel(pack: int) -> Any:
    bit_pack, mask_pack, sum_pack = pack_type(pack, wp.uint64), pack_type(pack, wp.uint8), pack_type(pack, wp.int32)
    cost_pack = pack_type(pack, wp.float32)

    @wp.kernel(enable_backward=False, module="unique", module_options={"max_unroll": 0})
    def probe_kernel(first: int,
                     left: wp.array(dtype=wp.uint64, ndim=3),  # [F, R, C …]
                     right: wp.array(dtype=bit_pack, ndim=3),  # [F, R, margin + C' + margin] overlapping packs
                     seen: wp.array(dtype=mask_pack, ndim=2),  # [R, margin + C' + margin] overlapping packs
                     rows: int,
                     cols: int,
                     packs: int,
                     start: int,
                     step: int,
                     scale: float,
                     # outputs
                     label: wp.array(dtype=wp.int32, ndim=2),  # [samples down, samples across]
                     lead: wp.array(dtype=wp.float32, ndim=2)):  # [samples down, samples across]
        i = first + wp.tid()
        across = label.shape[1]
        row = i // across
        col = i - row * across
        r = wp.min(row * step + step // 2, rows - 1)
        c = wp.min(col * step + step // 2, cols - 1)
        # the three best labels of each lane: two of one lane can lie within APART of the chosen one
        best, better, good = cost_pack(), cost_pack(), cost_pack()
        where, where_better, where_good = sum_pack(), sum_pack(), sum_pack()
        for k in range(pack):
            best[k] = float(FAR)
            better[k] = float(FAR)
            good[k] = float(FAR)
        for j in range(packs):
            at = c + start + j * pack
            sums = sum_pack()
            for f in range(left.shape[0]):
                for dy in range(-1, 2):
                    y = wp.clamp(r + SPREAD * dy, 0, rows - 1)
                    for dx in range(-1, 2):
                        x = wp.clamp(c + SPREAD * dx, 0, cols - 1)
                        here = left[f, y, x]
                        there = right[f, y, at + x - c]
                        for k in range(pack):
                            sums[k] = sums[k] + int(wp.bit_count(here ^ there[k]))
            held = seen[r, at]
            for k in range(pack):
                cost = wp.where(held[k] > wp.uint8(0), scale * float(sums[k]), float(9 * CHANCE))
                here_label = j * pack + k
                where_good[k] = wp.where(cost < better[k], where_better[k], wp.where(cost < good[k], here_label, where_good[k]))
                good[k] = wp.min(good[k], wp.max(better[k], cost))
                where_better[k] = wp.where(cost < best[k], where[k], wp.where(cost < better[k], here_label, where_better[k]))
                better[k] = wp.min(better[k], wp.max(best[k], cost))
                where[k] = wp.where(cost < best[k], here_label, where[k])
                best[k] = wp.min(cost, best[k])
        least = best[0]
        chosen = where[0]
        for k in range(1, pack):
            if best[k] < least or (best[k] == least and where[k] < chosen):  # the smaller label, whatever the pack width
                least = best[k]
                chosen = where[k]
        second = float(FAR)
        for k in range(pack):
            second = wp.min(second, wp.where(wp.abs(where[k] - chosen) > APART, best[k], float(FAR)))
            second = wp.min(second, wp.where(wp.abs(where_better[k] - chosen) > APART, better[k], float(FAR)))
            second = wp.min(second, wp.where(wp.abs(where_good[k] - chosen) > APART, good[k], float(FAR)))
        label[row, col] = chosen
        lead[row, col] = (second - least) / float(9 * CHANCE)

    return probe_kernel
