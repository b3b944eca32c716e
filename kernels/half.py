"""Single precision to half on the host: NumPy converts one value at a time, the kernel a SIMD register of them."""

from functools import cache
from typing import Any

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.packs import pack_type

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


@cache
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
