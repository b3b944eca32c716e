"""The census transform: which neighbours of a pixel are darker than it is, one bit for each.

Bits do not change with the gain and the offset of a camera, so that two cameras need no common exposure.

Source: Zabih and Woodfill, "Non-parametric local transforms for computing visual correspondence", ECCV 1994.
"""

from typing import Any

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
    devices.launch(_kernel(pack), count * rows * packs, [sliding(source), rows, packs, before], [sliding(bits)], device=device)
    return bits


@once
def _kernel(pack: int) -> Any:
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
