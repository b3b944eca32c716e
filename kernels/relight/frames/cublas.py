"""Matrix products of frame weights and the stack by cuBLAS, where the extra `gpu` (nvmath-python and cuBLAS) is installed.

The stack is half, and cuBLAS multiplies matrices of one type with sums in float32. So the weights of a frame become two halves each,
w = 2^e (h + 2^-11 r): h has the first 11 bits of a weight and r the next 11, so that weights are as exact as float32 down to a 2^-12th of
the frame's largest, and off by a 2^-35th of the largest below. Two products add up in the same output, and the stack is read twice for up
to GROUP frames; the kernel beside it (combine.py) reads it once for eight.

Every call makes GROUP frames, some of them zero: cuBLAS may sum in another order for another count, and a frame at the same position must
be identical to the last bit whichever others are made. For the same reason this product is used for every count of frames, or not at all,
and e is that of the frame: frames of another e in the same group have products of their own, which add zeros to the others. Factors that
are powers of two round nothing.
"""

import importlib
import importlib.util
import logging
import threading
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from kernels.device import once
from kernels.packs import Band

GROUP = 32
"""Number of frames in every call; missing ones are padded with zero frames."""
SPLIT_BITS = 11
"""Bits of a half, with the hidden one: the second half of a weight is what the first leaves, times two to this power."""
TOLERANCE = 2e-6
"""Relative difference of sums of positive terms from those in another order: some roundings of float32 and of split weights."""
EXPONENTS = 8
"""Exponents are multiples of this, so that the frames of a range nearly always share one."""
PACKAGE = "nvmath"
FLOAT32, FLOAT16 = 0, 2
"""CUDA_R_32F and CUDA_R_16F of cudaDataType."""
COMPUTE_FLOAT32 = 68
"""CUBLAS_COMPUTE_32F: products of halves are exact and summed in float32."""
NOT_TRANSPOSED, ANY_ALGORITHM = 0, -1
"""CUBLAS_OP_N and CUBLAS_GEMM_DEFAULT."""


class Product(NamedTuple):
    """The arguments of one cublasGemmStridedBatchedEx after the handle: C = alpha A B + beta C for each channel, column by column.

    What is stored row by row is its transpose for cuBLAS. So A is the stack, a column for each light, B the weights, a column for each
    frame, and C the frames, a column for each.
    """

    pixels: int
    frames: int
    lights: int
    alpha: float
    a: int
    """Address of the stack, halves."""
    a_column: int
    """Elements from one light to the next."""
    a_channel: int
    """Elements from one channel to the next, as of the others."""
    b: int
    b_column: int
    b_channel: int
    beta: float
    c: int
    c_column: int
    c_channel: int


_calling = threading.Lock()
"""Held while a product is queued: the stream of a handle is set just before."""

Gemm = Callable[[Product], None]
"""A function that computes a matrix product."""


def product_of(device: str) -> Gemm | None:
    """Return the product of cuBLAS on a device, or None where the extra is not installed or does not work; the log says why it does not."""
    return _open(device).gemm if device != "cpu" and is_installed() else None


@once
def is_installed() -> bool:
    """Return whether the extra is installed."""
    return importlib.util.find_spec(PACKAGE) is not None


def describe(device: str) -> str:
    """Return whether batches of frames are products of cuBLAS on a CUDA device, in a line for `relit doctor`."""
    if not is_installed():
        return "not installed: batches of frames use a kernel of relit (pip install 'relit[gpu]')"
    return _open(device).problem or "makes batches of frames"


def combine_by(gemm: Gemm, band: Band, weights: np.ndarray) -> wp.array:
    """Relight many frames by products that are done in the order of the device's stream; as combine.combine_batch."""
    lights = band.frame_count
    pixels = band.packs * band.values.dtype._length_
    groups = -(-len(weights) // GROUP)
    calls = split(weights)
    halves = wp.array(np.stack([half for call in calls for half in (call.first, call.second)]) if calls else
                      np.zeros((0, 3, GROUP, lights), np.float16), dtype=wp.float16, device=band.device)
    frames = wp.empty((groups * GROUP, 3, pixels), dtype=wp.float32, device=band.device)
    row = band.values.strides[0] // np.dtype(np.float16).itemsize
    for number, call in enumerate(calls):
        for half, (shift, beta) in enumerate(((0, 0.0 if call.is_first else 1.0), (-SPLIT_BITS, 1.0))):
            gemm(Product(pixels, GROUP, lights, 2.0 ** (call.exponent + shift), band.values.ptr, row, lights * row,
                         halves.ptr + (2 * number + half) * halves.strides[0], lights, GROUP * lights, beta,
                         frames.ptr + call.group * GROUP * frames.strides[0], 3 * pixels, pixels))
    return frames[: len(weights)]


class SplitWeights(NamedTuple):
    """The weights of the frames of a group that share an exponent; those of its other frames are 0."""

    group: int
    exponent: int
    first: np.ndarray  # [3, GROUP, lights] float16, h; its magnitude is below 2^EXPONENTS
    second: np.ndarray  # [3, GROUP, lights] float16, r
    is_first: bool
    """True if no other weights of the group come before."""


def split(weights: np.ndarray) -> list[SplitWeights]:
    """Return finite float32 weights [frames, 3, lights] as two halves each, group by group."""
    found = []
    for group, begin in enumerate(range(0, len(weights), GROUP)):
        mine = weights[begin : begin + GROUP].astype(np.float64)
        largest = np.abs(mine).max(axis=(1, 2), initial=0)
        exponents = (np.frexp(largest)[1] - 1) // EXPONENTS * EXPONENTS
        present = np.unique(exponents[largest > 0]) if (largest > 0).any() else np.zeros(1, int)
        for place, exponent in enumerate(present):
            scaled = np.zeros((GROUP, *weights.shape[1:]))
            scaled[: len(mine)] = np.where((exponents == exponent)[:, None, None], np.ldexp(mine, -exponent), 0)
            first = scaled.astype(np.float16)
            second = np.ldexp(scaled - first, SPLIT_BITS).astype(np.float16)
            found.append(SplitWeights(group, int(exponent), first.swapaxes(0, 1), second.swapaxes(0, 1), place == 0))
    return found


class _Opened(NamedTuple):
    gemm: Gemm | None
    problem: str | None


@once
def _open(device: str) -> _Opened:
    """Open cuBLAS on a CUDA device once; the handle lives as long as the process."""
    try:
        cublas = importlib.import_module(f"{PACKAGE}.bindings.cublas")
        with wp.ScopedDevice(device):
            handle = cublas.create()
    except Exception as error:  # no library, no driver, another version: each has an exception of its own
        problem = f"does not work ({' '.join(str(error).split())}): batches of frames use a kernel of relit"
        logging.getLogger(__name__).warning("cuBLAS on %s %s", device, problem)
        return _Opened(None, problem)
    return _Opened(partial(_call, cublas, handle, device), None)


def _call(cublas: Any, handle: int, device: str, product: Product) -> None:
    """Do a product on the stream of Warp."""
    p = product
    alpha, beta = np.float32(p.alpha).reshape(1), np.float32(p.beta).reshape(1)  # read before the call returns
    with _calling, wp.ScopedDevice(device):
        cublas.set_stream(handle, wp.get_stream(device).cuda_stream)
        cublas.gemm_strided_batched_ex(
            handle, NOT_TRANSPOSED, NOT_TRANSPOSED, p.pixels, p.frames, p.lights, alpha.ctypes.data,
            p.a, FLOAT16, p.a_column, p.a_channel, p.b, FLOAT16, p.b_column, p.b_channel, beta.ctypes.data,
            p.c, FLOAT32, p.c_column, p.c_channel, 3, COMPUTE_FLOAT32, ANY_ALGORITHM)
