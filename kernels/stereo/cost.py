"""The cost of every disparity at every pixel: how many bits of the census differ, over all frames.

The census transform has a bit for each neighbour of a pixel that is darker than it is. Bits do not change with the gain and the offset of a
camera, so that two cameras need no common exposure.

Source: Zabih and Woodfill, "Non-parametric local transforms for computing visual correspondence", ECCV 1994.
"""

from typing import Any, NamedTuple

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.device import once
from kernels.packs import new_array, pack_type


def sliding(array: wp.array, pack: int | None = None) -> wp.array:
    """Return a view of rows of scalars whose element at a column is the pack of values from that column on.

    The packs of neighbouring columns overlap. The last `pack - 1` columns have no pack: pad the rows. The caller keeps the array, because
    the view does not own the memory.
    """
    kind = array.dtype
    pack = devices.pack_width(str(array.device)) if pack is None else pack
    *rows, cols = array.shape
    strides: tuple[Any, ...] = tuple(array.strides)
    return wp.array(ptr=array.ptr, shape=(*rows, cols - pack + 1), strides=strides, dtype=pack_type(pack, kind), device=array.device,
                    copy=False)


def padded_columns(columns: int, device: str) -> int:
    """Return the number of columns of whole packs that cover `columns`, and one pack more for packs that begin within the last."""
    pack = devices.pack_width(device)
    return -(-columns // pack) * pack + pack


REACH_X, REACH_Y = 4, 3
"""Half sides of the window: 9 × 7 pixels, whose 62 neighbours nearly fill 64 bits."""
BITS = (2 * REACH_X + 1) * (2 * REACH_Y + 1) - 1
"""Bits that count."""


def census(images: np.ndarray, *, before: int = 0, after: int = 0, device: str) -> wp.array:
    """Return the census of each pixel of several images, [images, rows, before + cols + after or more] uint64.
    `images`: [images, rows, cols] float32; pixels beyond the border are those at the border. `before`, `after`: columns without a meaning
    that are put before the first column and after the last."""
    count, rows, cols = images.shape
    padded = padded_columns(cols, device)
    right = padded + REACH_X - cols
    around = np.pad(images, ((0, 0), (REACH_Y, REACH_Y), (REACH_X, right)), mode="edge")
    source = wp.array(np.ascontiguousarray(around, np.float32), dtype=wp.float32, device=device)
    bits = new_array((count, rows, before + padded + after), wp.uint64, device, cleared=True)
    pack = devices.pack_width(device)
    packs = -(-cols // pack)
    devices.launch(_census_kernel(pack), count * rows * packs, [sliding(source), rows, packs, before], [sliding(bits)], device=device)
    return bits


@once
def _census_kernel(pack: int) -> Any:
    image_pack, bit_pack = pack_type(pack, wp.float32), pack_type(pack, wp.uint64)

    @wp.kernel(enable_backward=False, module="unique", module_options={"max_unroll": 0})
    def census_kernel(first: int,
                      images: wp.array(dtype=image_pack, ndim=3),  # [F, REACH_Y + R + REACH_Y, REACH_X + C + …] overlapping packs
                      rows: int,
                      packs: int,
                      before: int,
                      # outputs
                      bits: wp.array(dtype=bit_pack, ndim=3)):  # [F, R, before + C + …] overlapping packs
        i = first + wp.tid()
        j = i % packs
        r = (i // packs) % rows
        f = i // (packs * rows)
        c = j * pack
        here = images[f, r + REACH_Y, c + REACH_X]
        found = bit_pack()
        for dy in range(2 * REACH_Y + 1):
            for dx in range(2 * REACH_X + 1):
                if dx != REACH_X or dy != REACH_Y:
                    there = images[f, r + dy, c + dx]
                    for k in range(pack):
                        found[k] = (found[k] << wp.uint64(1)) | wp.where(there[k] < here[k], wp.uint64(1), wp.uint64(0))
        bits[f, r, before + c] = found

    return census_kernel


SCALE = 4
"""Units of cost for one differing bit of the 62, so that the mean over frames keeps a fraction and fits eight bits."""
CHANCE = SCALE * BITS // 2
"""Cost of two places that have nothing to do with each other. Disparities that lead out of the other image have it too."""


class Labels(NamedTuple):
    """The disparities that are compared: `highest`, `highest - 1`, … in `packs` packs, so that the right column rises with the label."""

    highest: int
    packs: int

    def count(self, device: str) -> int:
        """Return how many disparities there are."""
        return self.packs * devices.pack_width(device)

    @classmethod
    def covering(cls, least: float, most: float, device: str) -> "Labels":
        """Return labels for all disparities from `least` to `most`."""
        highest = int(np.ceil(most))
        return cls(highest, -(-(highest - int(np.floor(least)) + 1) // devices.pack_width(device)))


class Margins(NamedTuple):
    """Columns before the first of the right image and after its last, to which labels of a pixel and of its neighbours lead."""

    before: int
    after: int

    @classmethod
    def of(cls, columns: int, right_columns: int, labels: Labels, device: str) -> "Margins":
        """Return the margins that labels of a left image need."""
        pack = devices.pack_width(device)
        last = columns - 1 - labels.highest + labels.count(device) + pack
        return cls(max(0, labels.highest) + pack, max(0, last - right_columns) + pack)


class CensusPair(NamedTuple):
    """The census of both images, the right one with the columns around it to which labels lead."""

    left: wp.array  # [frames, rows, cols …] uint64
    right: wp.array  # [frames, rows, margin + right cols + margin] uint64
    seen: wp.array  # [rows, margin + right cols + margin] uint8, 0 in the margins and where the right camera sees nothing
    start: int
    """The column of `right` that the first label of the pixel in column 0 leads to."""


def census_pair(left: np.ndarray, right: np.ndarray, seen: np.ndarray, labels: Labels, *, device: str) -> CensusPair:
    """Return the census of both images; the arguments are those of `matching_cost`."""
    margins = Margins.of(left.shape[2], right.shape[2], labels, device)
    left_bits = census(left, device=device)
    right_bits = census(right, before=margins.before, after=margins.after, device=device)
    held = np.zeros(right_bits.shape[1:], np.uint8)
    held[:, margins.before:margins.before + right.shape[2]] = seen
    return CensusPair(left_bits, right_bits, wp.array(held, dtype=wp.uint8, device=device), margins.before - labels.highest)


def matching_cost(
    left: np.ndarray,  # [frames, rows, cols] float32, rectified
    right: np.ndarray,  # [frames, rows, right cols] float32
    seen: np.ndarray,  # [rows, right cols] bool, False where the right camera sees nothing
    labels: Labels, *, device: str,
) -> wp.array:
    """Return the cost of each label at each pixel: `SCALE` units for each differing bit, the mean over the frames.
    Returns [rows, cols, packs] packs of uint8."""
    frames, rows, cols = left.shape
    bits = census_pair(left, right, seen, labels, device=device)
    pack = devices.pack_width(device)
    volume = new_array((rows, cols, labels.packs), pack_type(pack, wp.uint8), device, cleared=False)
    devices.launch(_kernel(pack), rows * cols,
                   [bits.left, sliding(bits.right), sliding(bits.seen), cols, bits.start, SCALE / frames], [volume], device=device)
    return volume


@once
def _kernel(pack: int) -> Any:
    cost_pack, bit_pack, sum_pack = pack_type(pack, wp.uint8), pack_type(pack, wp.uint64), pack_type(pack, wp.int32)

    @wp.kernel(enable_backward=False, module="unique", module_options={"max_unroll": 0})
    def cost_kernel(first: int,
                    left: wp.array(dtype=wp.uint64, ndim=3),  # [F, R, C …]
                    right: wp.array(dtype=bit_pack, ndim=3),  # [F, R, margin + C' + margin] overlapping packs
                    seen: wp.array(dtype=cost_pack, ndim=2),  # [R, margin + C' + margin] overlapping packs
                    cols: int,
                    start: int,
                    scale: float,
                    # outputs
                    volume: wp.array(dtype=cost_pack, ndim=3)):  # [R, C, packs]
        i = first + wp.tid()
        r = i // cols
        c = i - r * cols
        for j in range(volume.shape[2]):
            at = c + start + j * pack
            sums = sum_pack()
            for f in range(left.shape[0]):
                here = left[f, r, c]
                there = right[f, r, at]
                for k in range(pack):
                    sums[k] = sums[k] + int(wp.bit_count(here ^ there[k]))
            held = seen[r, at]
            costs = cost_pack()
            for k in range(pack):
                costs[k] = wp.uint8(wp.where(held[k] > wp.uint8(0), int(scale * float(sums[k]) + 0.5), CHANCE))
            volume[r, c, j] = costs

    return cost_kernel
