"""Semi-global matching: the costs of each pixel's disparities, and of changes of disparity along lines that lead to it.

Along each direction r the least cost of a path that ends in pixel p with disparity d is
L(p, d) = C(p, d) + min(L(p-r, d), L(p-r, d±1) + P1, min L(p-r, ·) + P2) - min L(p-r, ·); the sum over the directions is minimised.

Source: Hirschmüller, "Stereo processing by semiglobal matching and mutual information", TPAMI 30(2), 2008, eq. 13 and 14.
"""

from typing import Any, NamedTuple

import warp as wp

from kernels import device as devices
from kernels.device import once
from kernels.pack_access import pack_load, pack_store
from kernels.packs import new_array, pack_type
from kernels.stereo.cost import SCALE

SMALL_STEP = 5 * SCALE
"""P1: what a change of disparity by one costs, on slanted surfaces: five bits of the census."""
LARGE_STEP = 26 * SCALE
"""P2: what a larger change costs: nearly as much as a pixel that fits nowhere."""
SPAN = 16
"""Neighbouring lines that one CPU thread follows down the image together, so that it reads memory in order."""
FAR = 20000
"""A cost above all others, of disparities outside the range."""


class Direction(NamedTuple):
    """One direction along which costs are gathered."""

    down: int
    across: int


DIRECTIONS = Direction(0, 1), Direction(0, -1), Direction(1, 0), Direction(-1, 0)
"""Directions of the paths: along rows and columns, both ways. Under projected texture the source's diagonals change neither the share of
wrong pixels nor the error, and take as long again."""


def gather(volume: wp.array) -> wp.array:
    """Return the sum over all directions of the least costs of paths, [rows, cols, packs] packs of int16, from those of `matching_cost`."""
    rows, cols, packs = volume.shape
    device = str(volume.device)
    pack = devices.pack_width(device)
    sums = new_array((rows, cols, packs), pack_type(pack, wp.int16), device, cleared=True)
    for down, across in DIRECTIONS:
        lines = rows if down == 0 else cols
        # a path's costs at the pixel before and at this one, with a pack of `FAR` on either side
        before = new_array((lines, 2, packs + 2), pack_type(pack, wp.int16), device, cleared=False)
        if device != "cpu":
            width = devices.warp_width(device)
            devices.launch(_warp_kernel(pack), lines * width, [volume, before, width, down, across], [sums], device=device)
            continue
        floors = new_array((lines,), wp.int16, device, cleared=True)
        span = 1 if down == 0 else SPAN
        devices.launch(_kernel(pack), -(-lines // span), [volume, before, floors, span, down, across], [sums], device=device)
    return sums


@wp.func
def least_change(below: wp.int16, here: wp.int16, above: wp.int16, ceiling: wp.int16):
    """Return the least cost of the pixel before and of a change of disparity, which `ceiling` is for large ones."""
    return wp.min(wp.min(here, wp.min(below, above) + wp.int16(SMALL_STEP)), ceiling)


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    for (int away = warpSize / 2; away > 0; away /= 2)
        value = wp::min(value, __shfl_xor_sync(0xffffffff, value, away));
    __syncwarp();
#endif
    return value;
""")
def least_of_warp(value: int) -> int:
    """Return the least value among the threads of a CUDA warp, each of which then sees what the others have written."""
    ...


@once
def _warp_kernel(pack: int) -> Any:
    """Return the CUDA kernel: a warp for a line, whose threads take neighbouring disparities and read them together."""
    cost_pack, sum_pack = pack_type(pack, wp.uint8), pack_type(pack, wp.int16)
    load, load_costs, store = pack_load(pack, wp.int16, 3), pack_load(pack, wp.uint8, 3), pack_store(pack, wp.int16, 3)

    @wp.kernel(enable_backward=False, module="unique", module_options={"max_unroll": 0})
    def warp_kernel(first: int,
                    volume: wp.array(dtype=cost_pack, ndim=3),  # [R, C, packs]
                    before: wp.array(dtype=sum_pack, ndim=3),  # [lines, 2, packs + 2], scratch
                    width: int,  # threads of a line: a warp
                    down: int,
                    across: int,
                    # outputs
                    sums: wp.array(dtype=sum_pack, ndim=3)):  # [R, C, packs], added to
        thread = first + wp.tid()
        line = thread / width
        lane = thread % width
        rows = volume.shape[0]
        cols = volume.shape[1]
        packs = volume.shape[2]
        far = sum_pack()
        for k in range(pack):
            far[k] = wp.int16(FAR)
        for j in range(lane, packs + 2, width):  # as if all disparities of the pixel before the first cost nothing
            edge = j == 0 or j == packs + 1
            begin = sum_pack()
            if edge:
                begin = far
            store(before, line, 0, j, begin)
            store(before, line, 1, j, far)
        least = least_of_warp(0)
        for step in range(wp.where(down == 0, cols, rows)):
            old = step % 2
            r = wp.where(down == 0, line, wp.where(down > 0, step, rows - 1 - step))
            c = wp.where(down != 0, line, wp.where(across > 0, step, cols - 1 - step))
            ceiling = wp.int16(least + LARGE_STEP)
            lowest = wp.int16(FAR)
            for j in range(lane, packs, width):
                previous = load(before, line, old, j)
                here = load(before, line, old, j + 1)
                following = load(before, line, old, j + 2)
                costs = load_costs(volume, r, c, j)
                total = load(sums, r, c, j)
                found = sum_pack()
                for k in range(pack):
                    lower = wp.where(k == 0, previous[pack - 1], here[(k + pack - 1) % pack])
                    upper = wp.where(k == pack - 1, following[0], here[(k + 1) % pack])
                    found[k] = wp.int16(costs[k]) + least_change(lower, here[k], upper, ceiling) - wp.int16(least)
                    lowest = wp.min(lowest, found[k])
                    total[k] = total[k] + found[k]
                store(before, line, 1 - old, j + 1, found)
                store(sums, r, c, j, total)
            least = least_of_warp(int(lowest))

    return warp_kernel


@once
def _kernel(pack: int) -> Any:
    """Return the CPU kernel: one thread for some lines, all disparities of a pixel one after another."""
    cost_pack, sum_pack = pack_type(pack, wp.uint8), pack_type(pack, wp.int16)

    @wp.kernel(enable_backward=False, module="unique", module_options={"max_unroll": 0})
    def paths_kernel(first: int,
                     volume: wp.array(dtype=cost_pack, ndim=3),  # [R, C, packs]
                     before: wp.array(dtype=sum_pack, ndim=3),  # [lines, 2, packs + 2], scratch
                     floors: wp.array(dtype=wp.int16),  # [lines], scratch
                     span: int,
                     down: int,
                     across: int,
                     # outputs
                     sums: wp.array(dtype=sum_pack, ndim=3)):  # [R, C, packs], added to
        block = first + wp.tid()
        rows = volume.shape[0]
        cols = volume.shape[1]
        packs = volume.shape[2]
        lines = before.shape[0]
        steps = wp.where(down == 0, cols, rows)
        far = sum_pack()
        for k in range(pack):
            far[k] = wp.int16(FAR)
        last = wp.min((block + 1) * span, lines)
        for line in range(block * span, last):
            for side in range(2):
                before[line, side, 0] = far
                before[line, side, packs + 1] = far
        for step in range(steps):
            old = step % 2
            new = 1 - old
            for line in range(block * span, last):
                r = wp.where(down == 0, line, wp.where(down > 0, step, rows - 1 - step))
                c = wp.where(down != 0, line, wp.where(across > 0, step, cols - 1 - step))
                least = floors[line]
                if step == 0:  # as if all disparities of the pixel before cost nothing
                    for j in range(packs):
                        before[line, old, j + 1] = sum_pack()
                ceiling = least + wp.int16(LARGE_STEP)
                lowest = far
                previous = before[line, old, 0]
                here = before[line, old, 1]
                for j in range(packs):
                    following = before[line, old, j + 2]
                    costs = volume[r, c, j]
                    total = sums[r, c, j]
                    below = previous[pack - 1]
                    above = following[0]
                    found = sum_pack()
                    for k in range(pack):  # written so that it becomes SIMD code
                        lower = wp.where(k == 0, below, here[(k + pack - 1) % pack])
                        upper = wp.where(k == pack - 1, above, here[(k + 1) % pack])
                        found[k] = wp.int16(costs[k]) + least_change(lower, here[k], upper, ceiling) - least
                    for k in range(pack):
                        lowest[k] = wp.min(lowest[k], found[k])
                    for k in range(pack):
                        total[k] = total[k] + found[k]
                    before[line, new, j + 1] = found
                    sums[r, c, j] = total
                    previous = here
                    here = following
                least = wp.int16(FAR)
                for k in range(pack):
                    least = wp.min(least, lowest[k])
                floors[line] = least

    return paths_kernel
