"""Packs: vectors of neighbouring pixels that one thread takes together, and a stack band laid out as packs.

One thread loads a whole pack at once: SIMD lanes on the CPU (32 pixels), one wide load on CUDA (4 pixels).

A Warp array keeps its strides as 32-bit counts of bytes, and a larger one wraps around without a word. One channel of a stack
can be larger than that, one light of it is not: so channels and lights share the row axis of a band.

A kernel loads a pack by an assignment of its own: `x = values[0, p]` copies it once. After `x, y = values[0, p], values[1, p]` both names
refer to memory, and each lane that reads one of them loads its whole pack again, which keeps the compiler from using SIMD.
"""

from typing import Any, NamedTuple

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.device import PACK_CPU, once
from kernels.errors import ArrayError

STRIDE_LIMIT = 1 << 31
"""Bytes: strides of Warp arrays stay below."""
LINE_BYTES = 64
"""Bytes of a cache line, at which arrays begin, so that no SIMD store crosses one."""
MAX_PIXELS = STRIDE_LIMIT // 12 // PACK_CPU * PACK_CPU - PACK_CPU
"""Pixels of one band, 178 million: a relit float32 RGB frame of them stays below the limit."""


@once
def pack_type(length: int, dtype: type) -> Any:
    """Return the Warp vector type of `length` values of `dtype`."""
    return wp.types.vector(length=length, dtype=dtype)


@once
def channels_type(length: int) -> Any:
    """Return the Warp matrix type of three channels of `length` float32 values."""
    return wp.types.matrix(shape=(3, length), dtype=wp.float32)


@wp.func
def bit_of(byte: wp.uint8, frame: int) -> int:
    """Return the bit of a frame, 0 or 1, from the byte of Band.saturated that has it."""
    return (int(byte) >> (frame % 8)) & 1


@wp.func
def vector_at(planes: wp.array2d(dtype=Any), at: int):
    """Return the packs of x, y and z at a place, [3, …] planes."""
    return planes[0, at], planes[1, at], planes[2, at]


class Band(NamedTuple):
    """Readings of a pixel range on a device, as packs, and which of them saturate.

    A stack of lights has its rows channel by channel, as `upload` takes it; frames of projected patterns have theirs frame by frame, as
    `structured.frames.upload` does.
    """

    values: wp.array  # [channel · frame, pack] half packs: stored radiance, or [frame · channel, pack] float32 packs: linear readings
    saturated: wp.array  # [⌈frame / 8⌉, pack] uint8 packs: bit f % 8 of byte f // 8
    pixel_count: int
    frame_count: int
    """Frames: one for each light, padding included, or one for each pattern."""
    device: str
    owner: tuple[Any, ...]
    """The objects that own the memory: a band is valid while this tuple lives."""

    @property
    def packs(self) -> int:
        """Number of packs that cover the pixels."""
        return int(self.values.shape[1])

    def require_channels(self, count: int) -> None:
        """Refuse a band of another number of channels.

        Raises:
            ArrayError: naming what was got and what was expected.
        """
        channels = self.values.shape[0] // self.frame_count
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
    if saturated is None:
        saturated = np.zeros((lights // 8, pixels), dtype=np.uint8)
    if saturated.shape != (lights // 8, pixels) or saturated.dtype != np.uint8:
        raise ArrayError(f"saturated is {saturated.dtype} {saturated.shape}: give uint8 {(lights // 8, pixels)}")
    return band_of(values.reshape(channels * lights, pixels), saturated, frame_count=lights, device=device)


def band_of(rows: np.ndarray, saturated: np.ndarray, *, frame_count: int, device: str) -> Band:
    """Return a band whose rows are laid out already; `upload` and `structured.frames.upload` check them first.

    Args:
        rows: [row, pixel] float16 or float32.
        saturated: [⌈frame / 8⌉, pixel] uint8 bits.
        frame_count: frames that the rows belong to.
        device: where.

    Raises:
        ArrayError: too many pixels.
    """
    pixels = rows.shape[1]
    if pixels > MAX_PIXELS:
        raise ArrayError(f"values have {pixels} pixels: cut them into bands of at most {MAX_PIXELS}")
    values, value_owner = place(rows, device)
    bits, bit_owner = place(saturated, device)
    return Band(values, bits, pixels, frame_count, device, (value_owner, bit_owner))


def padded_count(pixels: int, device: str) -> int:
    """Return the number of pixels after padding to whole packs."""
    pack = devices.pack_width(device)
    return -(-pixels // pack) * pack


def zeros(pixels: int, dtype: Any, device: str, *, rows: int | None = None) -> wp.array:
    """Return an output array of zeros, [pixels padded] or [rows, pixels padded], so that a kernel may leave pixels unwritten."""
    whole = padded_count(pixels, device)
    return new_array(whole if rows is None else (rows, whole), dtype, device, cleared=True)


def unwritten(pixels: int, dtype: Any, device: str, *, rows: int | None = None) -> wp.array:
    """Return an output array as `zeros` does, but with arbitrary values, for a kernel that writes every pixel: clearing it first would
    take as long as writing it."""
    whole = padded_count(pixels, device)
    return new_array(whole if rows is None else (rows, whole), dtype, device, cleared=False)


def new_array(shape: int | tuple[int, ...], dtype: Any, device: str, *, cleared: bool) -> wp.array:
    """Return a new array of scalars or packs, of zeros or of arbitrary values.

    On the CPU its memory is NumPy's, which asks the system for huge pages: touching 75 MB for the first time takes 7 ms with them and 36 ms
    without, as much as a kernel may take to compute the values.
    """
    whole = (shape,) if isinstance(shape, int) else shape
    if device != "cpu" or 0 in whole:
        return (wp.zeros if cleared else wp.empty)(shape, dtype=dtype, device=device)
    scalar = getattr(dtype, "_wp_scalar_type_", dtype)
    if scalar is not dtype:
        whole = (*whole, dtype._length_)
    kind = np.dtype(wp.dtype_to_numpy(scalar))
    size = int(np.prod(whole)) * kind.itemsize
    memory = (np.zeros if cleared else np.empty)(size + LINE_BYTES, dtype=np.uint8)
    begin = -memory.ctypes.data % LINE_BYTES
    return wp.array(memory[begin : begin + size].view(kind).reshape(whole), dtype=dtype, device="cpu", copy=False)


def as_packs(array: wp.array, device: str) -> wp.array:
    """Return a view of the same memory as packs: the last axis is divided by the pack width, which must divide it.

    The caller keeps the array: the view does not own the memory.
    """
    if not array.is_contiguous:
        raise ArrayError(f"array of shape {array.shape} is a slice with gaps: give a contiguous one")
    pack = devices.pack_width(device)
    *rows, length = array.shape
    if length % pack:
        raise ArrayError(f"array has {length} pixels: pad to a multiple of {pack}")
    bytes_of_pack = pack * wp.types.type_size_in_bytes(array.dtype)
    if array.ptr and device != "cpu" and array.ptr % bytes_of_pack:  # where CUDA loads a pack at once
        raise ArrayError(f"array begins {array.ptr % bytes_of_pack} bytes after a multiple of {bytes_of_pack}: give a whole array")
    return wp.array(ptr=array.ptr, shape=(*rows, length // pack), dtype=pack_type(pack, array.dtype), device=device, copy=False)


def as_pixels(packs: wp.array) -> wp.array:
    """Return a view of [row, pack] packs as [row, pixel] scalars; it does not own the memory."""
    kind, width = packs.dtype._wp_scalar_type_, packs.dtype._length_
    return wp.array(ptr=packs.ptr, shape=(packs.shape[0], packs.shape[1] * width), dtype=kind,
                    strides=(packs.strides[0], wp.types.type_size_in_bytes(kind)), device=packs.device, copy=False)


def take_columns(values: wp.array, columns: wp.array, start: int, taken: wp.array) -> None:
    """Copy columns of an array to another on the same device; not synchronised.

    Args:
        values: [rows, m], whose first column has the number `start`.
        columns: [n] int32 numbers.
        start: number of the first column of `values`.
        taken: [rows, n or more]; columns that `values` does not have stay as they are.
    """
    devices.launch(_columns_kernel(values.dtype), values.shape[0] * columns.shape[0], [values, columns, start], [taken],
                   device=values.device.alias)


@once
def _columns_kernel(dtype: Any) -> Any:
    @wp.kernel(enable_backward=False, module="unique")
    def columns_kernel(first: int,
                       values: wp.array2d(dtype=dtype),  # [rows, m]
                       columns: wp.array(dtype=wp.int32),  # [n]
                       start: int,  # number of the first column
                       # outputs
                       taken: wp.array2d(dtype=dtype)):  # [rows, n or more]
        thread = first + wp.tid()
        count = columns.shape[0]
        row, k = thread / count, thread % count
        column = columns[k] - start
        if column >= 0 and column < values.shape[1]:
            taken[row, k] = values[row, column]

    return columns_kernel


def place(array: np.ndarray, device: str) -> tuple[wp.array, Any]:
    """Return host rows as packs on the device, padded with zeros, and what owns their memory.

    Args:
        array: [row, pixel] float16, float32 or uint8. On the CPU it is not copied when its pixels divide into packs and its rows lie
            evenly spaced in memory.
        device: where.

    Returns:
        [row, pack] packs, and their owner.
    """
    pack, dtype = devices.pack_width(device), wp.dtype_from_numpy(array.dtype)
    short = -array.shape[1] % pack
    row_stride, stride = array.strides
    if short or stride != array.itemsize or not 0 <= row_stride < STRIDE_LIMIT:
        array = np.ascontiguousarray(np.pad(array, [(0, 0), (0, short)]))
    if device == "cpu":
        view = wp.array(ptr=array.ctypes.data, shape=(array.shape[0], array.shape[1] // pack),
                        strides=(array.strides[0], pack * array.itemsize), dtype=pack_type(pack, dtype), device="cpu", copy=False)
        return view, array
    owner = wp.array(array, dtype=dtype, device=device)
    return as_packs(owner, device), owner


HOST = "cpu"


def to_half(values: np.ndarray) -> np.ndarray:
    """Return values […] float32 as float16, rounded to the nearest, as `values.astype(np.float16)` does to the last bit.

    Values beyond the largest half become infinite.
    """
    flat = np.ascontiguousarray(values, dtype=np.float32).reshape(-1)
    found = np.empty(flat.shape, dtype=np.float16)
    pack = devices.pack_width(HOST)
    whole = len(flat) // pack * pack
    given, out = (wp.array(array[:whole].reshape(-1, pack), dtype=pack_type(pack, kind), device=HOST, copy=False)
                  for array, kind in ((flat, wp.float32), (found, wp.float16)))
    devices.launch(_half_kernel(pack), whole // pack, [given], [out], device=HOST)
    with np.errstate(over="ignore"):
        found[whole:] = flat[whole:]
    return found.reshape(values.shape)


@once
def _half_kernel(pack: int) -> Any:
    float_pack, half_pack = pack_type(pack, wp.float32), pack_type(pack, wp.float16)

    @wp.kernel(enable_backward=False, module="unique", module_options={"max_unroll": 0})
    def half_kernel(first: int,
                    values: wp.array(dtype=float_pack),  # [P]
                    # outputs
                    out: wp.array(dtype=half_pack)):  # [P]
        p = first + wp.tid()
        value = values[p]
        rounded = half_pack()
        for k in range(pack):
            rounded[k] = wp.float16(value[k])
        out[p] = rounded

    return half_kernel
