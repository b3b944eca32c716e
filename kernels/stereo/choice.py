"""The best disparity of each pixel, whether the other image agrees, and how well another disparity would fit.

A pixel that only one camera sees has no true disparity; the best one of its pixel in the other image is that of what hides it
(Hirschmüller 2008, section 2.6). Where the scene repeats itself, several disparities fit equally; the penalties of semi-global matching
choose one of them without any evidence, so that rivals are compared by the bare costs around the pixel.
"""

from typing import Any, NamedTuple

import warp as wp

from kernels import device as devices
from kernels.device import once
from kernels.pack_access import pack_load
from kernels.packs import new_array, pack_type
from kernels.stereo.cost import CHANCE, Labels, Margins, sliding
from kernels.stereo.paths import FAR

SPREAD = 2
"""Distance in pixels between the nine places around a pixel whose costs are added to compare rivals. With the window of the census they
cover 13 × 11 pixels."""
APART = 2
"""Labels farther from the best one are rivals; nearer ones share its minimum."""


class Choice(NamedTuple):
    """The choice at each pixel of a band of rows."""

    label: wp.array  # [rows, cols] int32, the best label
    fraction: wp.array  # [rows, cols] float32, by which the minimum of the path costs lies beyond the label, -0.5…0.5
    disagreement: wp.array  # [rows, cols] int32, labels between the best of the pixel and the best of its pixel in the other image
    fit: wp.array  # [rows, cols] float32, costs around the pixel relative to chance: 0 identical, 1 nothing in common
    lead: wp.array  # [rows, cols] float32, by how much the best rival fits worse, of the same unit


def choose(
    volume: wp.array,  # [rows, cols, packs] packs of uint8, of `matching_cost`
    sums: wp.array,  # [rows, cols, packs] packs of int16, of `gather`
    labels: Labels,  # of both
    *,
    right_columns: int,  # columns of the right image
) -> Choice:
    """Choose the disparity of each pixel. Returns arrays on the device, not synchronised on CUDA."""
    rows, cols, packs = volume.shape
    device = str(volume.device)
    pack = devices.pack_width(device)
    margins = Margins.of(cols, right_columns, labels, device)
    width = margins.before + right_columns + margins.after
    start = margins.before - labels.highest
    where = new_array((rows, width), wp.int16, device, cleared=False)
    each = wp.array(ptr=sums.ptr, shape=(rows, cols, packs * pack), dtype=wp.int16, device=device, copy=False)
    if device == "cpu":
        best = new_array((rows, width), wp.int16, device, cleared=False)
        best.fill_(FAR)
        devices.launch(_other_kernel(pack), rows, [sums, start], [sliding(best), sliding(where)], device=device)
    else:
        devices.launch(_gather_other_kernel, rows * width, [each, start], [where], device=device)
    kinds = wp.int32, wp.float32, wp.int32, wp.float32, wp.float32
    found = Choice(*(new_array((rows, cols), kind, device, cleared=False) for kind in kinds))
    inputs = [volume, sums, each, where, start]
    devices.launch(_choice_kernel(pack), rows * cols, inputs, list(found), device=device)
    return found


@wp.kernel(enable_backward=False)
def _gather_other_kernel(first: int,
                         each: wp.array(dtype=wp.int16, ndim=3),  # [R, C, labels]
                         start: int,
                         # outputs
                         where: wp.array(dtype=wp.int16, ndim=2)):  # [R, margin + C' + margin], label of the least sum of a right pixel
    """On CUDA: one thread for a right pixel, so that neighbouring threads read neighbouring sums."""
    i = first + wp.tid()
    r = i // where.shape[1]
    at = i - r * where.shape[1]
    least = wp.int16(FAR)
    label = wp.int32(0)
    for c in range(wp.max(at - start - each.shape[2] + 1, 0), wp.min(at - start + 1, each.shape[1])):
        here = each[r, c, at - start - c]
        if here < least:
            least = here
            label = at - start - c
    where[r, at] = wp.int16(label)


@once
def _other_kernel(pack: int) -> Any:
    """Return the CPU kernel: one thread for a row, all labels of a pixel after another, pack by pack."""
    sum_pack = pack_type(pack, wp.int16)

    @wp.kernel(enable_backward=False, module="unique", module_options={"max_unroll": 0})
    def other_kernel(first: int,
                     sums: wp.array(dtype=sum_pack, ndim=3),  # [R, C, packs]
                     start: int,
                     # outputs
                     best: wp.array(dtype=sum_pack, ndim=2),  # [R, margin + C' + margin] overlapping packs, least sum of a right pixel
                     where: wp.array(dtype=sum_pack, ndim=2)):  # [R, margin + C' + margin] overlapping packs, label of that sum
        r = first + wp.tid()
        for c in range(sums.shape[1]):
            for j in range(sums.shape[2]):
                at = c + start + j * pack
                least = best[r, at]
                label = where[r, at]
                here = sums[r, c, j]
                for k in range(pack):
                    label[k] = wp.where(here[k] < least[k], wp.int16(j * pack + k), label[k])
                for k in range(pack):
                    least[k] = wp.min(least[k], here[k])
                best[r, at] = least
                where[r, at] = label

    return other_kernel


@once
def _choice_kernel(pack: int) -> Any:
    cost_pack, sum_pack = pack_type(pack, wp.uint8), pack_type(pack, wp.int16)
    load_costs, load_sums = pack_load(pack, wp.uint8, 3), pack_load(pack, wp.int16, 3)

    @wp.kernel(enable_backward=False, module="unique", module_options={"max_unroll": 0})
    def choice_kernel(first: int,
                      volume: wp.array(dtype=cost_pack, ndim=3),  # [R, C, packs]
                      sums: wp.array(dtype=sum_pack, ndim=3),  # [R, C, packs]
                      each: wp.array(dtype=wp.int16, ndim=3),  # [R, C, labels], the same sums
                      other: wp.array(dtype=wp.int16, ndim=2),  # [R, margin + C' + margin], best label of each right pixel
                      start: int,
                      # outputs
                      label: wp.array(dtype=wp.int32, ndim=2),  # [R, C]
                      fraction: wp.array(dtype=wp.float32, ndim=2),  # [R, C]
                      disagreement: wp.array(dtype=wp.int32, ndim=2),  # [R, C]
                      fit: wp.array(dtype=wp.float32, ndim=2),  # [R, C]
                      lead: wp.array(dtype=wp.float32, ndim=2)):  # [R, C]
        i = first + wp.tid()
        rows = volume.shape[0]
        cols = volume.shape[1]
        packs = volume.shape[2]
        r = i // cols
        c = i - r * cols
        least = load_sums(sums, r, c, 0)
        held = sum_pack()
        for k in range(pack):
            held[k] = wp.int16(k)
        for j in range(1, packs):
            here = load_sums(sums, r, c, j)
            for k in range(pack):
                held[k] = wp.where(here[k] < least[k], wp.int16(j * pack + k), held[k])
            for k in range(pack):
                least[k] = wp.min(least[k], here[k])
        best = int(held[0])
        lowest = int(least[0])
        for k in range(1, pack):
            if int(least[k]) < lowest or (int(least[k]) == lowest and int(held[k]) < best):  # the smaller label, whatever the pack width
                lowest = int(least[k])
                best = int(held[k])
        label[r, c] = best
        beyond = float(0.0)
        if best > 0 and best < packs * pack - 1:
            below = float(each[r, c, best - 1])
            above = float(each[r, c, best + 1])
            bend = below + above - 2.0 * float(lowest)
            if bend > 0.0:
                beyond = 0.5 * (below - above) / bend
        fraction[r, c] = beyond
        disagreement[r, c] = wp.abs(int(other[r, c + start + best]) - best)
        alone = sum_pack()
        rival = sum_pack()
        for k in range(pack):
            alone[k] = wp.int16(FAR)
            rival[k] = wp.int16(FAR)
        for j in range(packs):
            around = sum_pack()
            for dy in range(-1, 2):
                y = wp.clamp(r + SPREAD * dy, 0, rows - 1)
                for dx in range(-1, 2):
                    x = wp.clamp(c + SPREAD * dx, 0, cols - 1)
                    costs = load_costs(volume, y, x, j)
                    for k in range(pack):
                        around[k] = around[k] + wp.int16(costs[k])
            for k in range(pack):
                away = wp.abs(j * pack + k - best)
                rival[k] = wp.min(rival[k], wp.where(away > APART, around[k], wp.int16(FAR)))
                alone[k] = wp.min(alone[k], wp.where(away <= 1, around[k], wp.int16(FAR)))
        own = alone[0]
        second = rival[0]
        for k in range(1, pack):
            own = wp.min(own, alone[k])
            second = wp.min(second, rival[k])
        fit[r, c] = float(own) / float(9 * CHANCE)
        lead[r, c] = float(second - own) / float(9 * CHANCE)

    return choice_kernel
