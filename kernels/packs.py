"""Packs: vectors of neighbouring pixels that one thread takes together, and a stack band laid out as packs.

One thread loads a whole pack at once: SIMD lanes on the CPU (32 pixels), one wide load on CUDA (4 pixels).

A Warp array keeps its strides as 32-bit counts of bytes, and a larger one wraps around without a word. One channel of a stack
can be larger than that, one light of it is not: so channels and lights share the row axis of a band.
"""

from functools import cache
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.device import PACK_CPU
from kernels.errors import ArrayError

STRIDE_LIMIT = 1 << 31
"""Bytes: strides of Warp arrays stay below."""
MAX_PIXELS = STRIDE_LIMIT // 12 // PACK_CPU * PACK_CPU - PACK_CPU
"""Pixels of one band, 178 million: a relit float32 RGB frame of them stays below the limit."""


@cache
def pack_type(length: int, dtype: type) -> Any:
    """The Warp vector type of `length` values of `dtype`."""
    return wp.types.vector(length=length, dtype=dtype)


class Band(NamedTuple):
    """A pixel range of a stack on a device, as packs."""

    values: wp.array  # [channel · light, pack] half packs: stored radiance, the lights of the first channel first
    saturated: wp.array  # [light / 8, pack] uint8 packs: bit l % 8 of byte l // 8
    pixel_count: int
    light_count: int
    device: str
    owner: tuple[Any, ...]
    """What owns the memory; a band is valid while this tuple lives."""

    @property
    def packs(self) -> int:
        """How many packs cover the pixels."""
        return int(self.values.shape[1])

    def require_channels(self, count: int) -> None:
        """Refuse a band of another number of channels.

        Raises:
            ArrayError: naming what was got and what was expected.
        """
        channels = self.values.shape[0] // self.light_count
        if channels != count:
            raise ArrayError(f"the band has {channels} channels, expected {count}: upload [{count}, light, pixel]")


def upload(values: np.ndarray, saturated: np.ndarray | None = None, *, device: str) -> Band:
    """Lay a pixel range of a stack out on the device.

    Args:
        values: [channel, light, pixel] float16; lights a multiple of 8.
        saturated: [light / 8, pixel] uint8 bits, or None when no reading saturates.
        device: where.

    Returns:
        The band. On the CPU nothing is copied when the pixels divide into packs and the lights lie evenly spaced in memory.

    Raises:
        ArrayError: wrong type or shape, or too many pixels.
    """
    if values.ndim != 3 or values.dtype != np.float16:
        raise ArrayError(f"values are {values.ndim}-dimensional {values.dtype}: give [channel, light, pixel] float16")
    channels, lights, pixels = values.shape
    if lights == 0 or lights % 8:
        raise ArrayError(f"values have {lights} lights: pad the light axis with zeros to a multiple of 8")
    if pixels > MAX_PIXELS:
        raise ArrayError(f"values have {pixels} pixels: cut them into bands of at most {MAX_PIXELS}")
    if saturated is None:
        saturated = np.zeros((lights // 8, pixels), dtype=np.uint8)
    if saturated.shape != (lights // 8, pixels) or saturated.dtype != np.uint8:
        raise ArrayError(f"saturated is {saturated.dtype} {saturated.shape}: give uint8 {(lights // 8, pixels)}")
    pack = devices.pack_width(device)
    value_packs, value_owner = _place(values.reshape(channels * lights, pixels), pack, wp.float16, device)
    bit_packs, bit_owner = _place(saturated, pack, wp.uint8, device)
    return Band(value_packs, bit_packs, pixels, lights, device, (value_owner, bit_owner))


def scalars(length: int, rows: int | None, dtype: Any, device: str) -> wp.array:
    """An output array whose last axis is pixels, padded to whole packs so that kernels can write it as packs."""
    pack = devices.pack_width(device)
    whole = -(-length // pack) * pack
    return wp.zeros(whole if rows is None else (rows, whole), dtype=dtype, device=device)


def as_packs(array: wp.array, device: str) -> wp.array:
    """The same memory as packs: the last axis is divided by the pack width, which must divide it.

    The caller keeps the array: the view does not own the memory.
    """
    if not array.is_contiguous:
        raise ArrayError(f"array of shape {array.shape} is a slice with gaps: give a contiguous one")
    pack = devices.pack_width(device)
    *rows, length = array.shape
    if length % pack:
        raise ArrayError(f"array has {length} pixels: pad to a multiple of {pack}")
    return wp.array(ptr=array.ptr, shape=(*rows, length // pack), dtype=pack_type(pack, array.dtype), device=device, copy=False)


def _place(array: np.ndarray, pack: int, dtype: Any, device: str) -> tuple[wp.array, Any]:
    # [row, pixel] → [row, pack] and what owns its memory
    short = -array.shape[1] % pack
    if device == "cpu":
        row_stride, stride = array.strides
        if short or stride != array.itemsize or not 0 <= row_stride < STRIDE_LIMIT:
            array = np.ascontiguousarray(np.pad(array, [(0, 0), (0, short)]))
        view = wp.array(ptr=array.ctypes.data, shape=(array.shape[0], array.shape[1] // pack),
                        strides=(array.strides[0], pack * array.itemsize), dtype=pack_type(pack, dtype), device="cpu", copy=False)
        return view, array
    if short:
        array = np.pad(array, [(0, 0), (0, short)])
    owner = wp.array(np.ascontiguousarray(array), dtype=dtype, device=device)
    return as_packs(owner, device), owner
