"""Packs: vectors of neighbouring pixels that one thread takes together, and a stack band laid out as packs.

One thread loads a whole pack at once: SIMD lanes on the CPU (32 pixels), one wide load on CUDA (4 pixels).
"""

from functools import cache
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.errors import ArrayError


@cache
def pack_type(length: int, dtype: type) -> Any:
    """The Warp vector type of `length` values of `dtype`."""
    return wp.types.vector(length=length, dtype=dtype)


class Band(NamedTuple):
    """A pixel range of a stack on a device, as packs."""

    values: wp.array  # [channel, light, pack] half packs: stored radiance
    saturated: wp.array  # [light / 8, pack] uint8 packs: bit l % 8 of byte l // 8
    pixel_count: int
    light_count: int
    device: str
    owner: tuple[Any, ...]
    """What owns the memory; a band is valid while this tuple lives."""

    @property
    def packs(self) -> int:
        """How many packs cover the pixels."""
        return int(self.values.shape[2])


def upload(values: np.ndarray, saturated: np.ndarray | None = None, *, device: str) -> Band:
    """Lay a pixel range of a stack out on the device.

    Args:
        values: [channel, light, pixel] float16; lights a multiple of 8.
        saturated: [light / 8, pixel] uint8 bits, or None when no reading saturates.
        device: where.

    Returns:
        The band. On the CPU nothing is copied when the pixels divide into packs.

    Raises:
        ArrayError: wrong type or shape.
    """
    if values.ndim != 3 or values.dtype != np.float16:
        raise ArrayError(f"values are {values.ndim}-dimensional {values.dtype}: give [channel, light, pixel] float16")
    _, lights, pixels = values.shape
    if lights == 0 or lights % 8:
        raise ArrayError(f"values have {lights} lights: pad the light axis with zeros to a multiple of 8")
    if saturated is None:
        saturated = np.zeros((lights // 8, pixels), dtype=np.uint8)
    if saturated.shape != (lights // 8, pixels) or saturated.dtype != np.uint8:
        raise ArrayError(f"saturated is {saturated.dtype} {saturated.shape}: give uint8 {(lights // 8, pixels)}")
    pack = devices.pack_width(device)
    value_packs, value_owner = _place(values, pack, wp.float16, device)
    bit_packs, bit_owner = _place(saturated, pack, wp.uint8, device)
    return Band(value_packs, bit_packs, pixels, lights, device, (value_owner, bit_owner))


def scalars(length: int, rows: int | None, dtype: Any, device: str) -> wp.array:
    """An output array whose last axis is pixels, padded to whole packs so that kernels can write it as packs."""
    pack = devices.pack_width(device)
    whole = -(-length // pack) * pack
    return wp.zeros(whole if rows is None else (rows, whole), dtype=dtype, device=device)


def as_packs(array: wp.array, device: str) -> wp.array:
    """The same memory as packs: the last axis is divided by the pack width, which must divide it."""
    pack = devices.pack_width(device)
    *rows, length = array.shape
    if length % pack:
        raise ArrayError(f"array has {length} pixels: pad to a multiple of {pack}")
    return wp.array(ptr=array.ptr, shape=(*rows, length // pack), dtype=pack_type(pack, array.dtype), device=device, copy=False)


def _place(array: np.ndarray, pack: int, dtype: Any, device: str) -> tuple[wp.array, Any]:
    pixels = array.shape[-1]
    short = -pixels % pack
    if device == "cpu":
        if short or array.strides[-1] != array.itemsize:
            array = np.pad(array, [(0, 0)] * (array.ndim - 1) + [(0, short)])
        strides = (*array.strides[:-1], pack * array.itemsize)
        view = wp.array(ptr=array.ctypes.data, shape=(*array.shape[:-1], array.shape[-1] // pack), strides=strides,
                        dtype=pack_type(pack, dtype), device="cpu", copy=False)
        return view, array
    if short:
        array = np.pad(array, [(0, 0)] * (array.ndim - 1) + [(0, short)])
    owner = wp.array(np.ascontiguousarray(array), dtype=dtype, device=device)
    return as_packs(owner, device), owner
