"""Frames as half on a CUDA device, as files hold them: half as many bytes go to the host, which converts none."""

from typing import Any

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.device import once
from kernels.pack_access import pack_load, pack_store
from kernels.packs import as_packs, pack_type

HALF_MAX = float(np.finfo(np.float16).max)


def to_halves(frames: wp.array) -> wp.array:
    """Return frames [..., pixels padded] float32 as half on the same device, rounded to the nearest; not synchronised.

    A value beyond HALF_MAX becomes infinite, also one that would be rounded to HALF_MAX, so that it is known to be beyond.
    """
    device = frames.device.alias
    pack = devices.pack_width(device)
    found = wp.empty(frames.shape, dtype=wp.float16, device=device)
    given, taken = (as_packs(array.flatten(), device) for array in (frames, found))
    devices.launch(_halves_kernel(pack), given.shape[0], [given], [taken], device=device)
    return found


@once
def _halves_kernel(pack: int) -> Any:
    half_pack, float_pack = pack_type(pack, wp.float16), pack_type(pack, wp.float32)
    load, store = pack_load(pack, wp.float32, 1), pack_store(pack, wp.float16, 1)

    @wp.kernel(enable_backward=False, module="unique", module_options={"max_unroll": 0})
    def halves_kernel(first: int,
                      values: wp.array(dtype=float_pack),  # [P]
                      # outputs
                      halves: wp.array(dtype=half_pack)):  # [P]
        p = first + wp.tid()
        value = load(values, p)
        rounded = half_pack()
        for k in range(pack):
            bounded = wp.where(value[k] > HALF_MAX, wp.inf, wp.where(value[k] < -HALF_MAX, -wp.inf, value[k]))
            rounded[k] = wp.float16(bounded)
        store(halves, p, rounded)

    return halves_kernel
