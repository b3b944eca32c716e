"""Packs that begin at any column: one load takes the pixels from a column on, wherever it lies."""

from typing import Any

import warp as wp

from kernels import device as devices
from kernels.packs import pack_type


def sliding(array: wp.array, pack: int | None = None) -> wp.array:
    """Return a view of rows of scalars whose element at a column is the pack of values from that column on.

    The packs of neighbouring columns overlap. The last `pack - 1` columns have no pack: pad the rows. The caller keeps the array, because
    the view does not own the memory.

    Args:
        array: [..., cols] scalars without gaps.
        pack: values of an element; None: the pack width of the device.
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
