"""Packs loaded and stored by one access on CUDA.

To Warp a pack is a vector without an alignment, which CUDA's compiler loads value by value. The functions below tell it that a pack lies
at a multiple of its size. That holds in whole arrays (CUDA aligns them to 256 bytes, `packs.as_packs` checks views) and not in overlapping
packs (`stereo.census.sliding`). On the CPU, where no such word exists, a pack is a vector as anywhere.

In a kernel: `x = load(values, row, p)` in place of `x = values[row, p]`, and `store(values, row, p, x)` in place of `values[row, p] = x`,
after `load = pack_load(pack, wp.float16)` outside of it.
"""

from typing import Any

import warp as wp

from kernels.device import once
from kernels.packs import pack_type

WORDS = {4: "unsigned int", 8: "uint2", 16: "uint4"}
"""CUDA's types that are loaded and stored at once, by their bytes."""
LOAD = """
#if defined(__CUDA_ARCH__)
    alignas({bytes}) wp::vec_t<{pack}, wp::{scalar}> loaded;
    reinterpret_cast<{word}&>(loaded) = *reinterpret_cast<const {word}*>({place});
    return loaded;
#else
    return *{place};
#endif
"""
STORE = """
#if defined(__CUDA_ARCH__)
    alignas({bytes}) const wp::vec_t<{pack}, wp::{scalar}> stored = x;
    *reinterpret_cast<{word}*>({place}) = reinterpret_cast<const {word}&>(stored);
#else
    *{place} = x;
#endif
"""
PLACES = {1: "wp::address(values, p)", 2: "wp::address(values, row, p)", 3: "wp::address(values, plane, row, p)"}
"""Address of a pack, by the axes of its array."""


@once
def pack_load(pack: int, dtype: type, axes: int = 2) -> Any:
    """Return the Warp function that loads a pack of `pack` values of `dtype` from an array of one to three axes."""
    kind = pack_type(pack, dtype)
    snippet = _snippet(LOAD, "    return *{place};\n", pack, dtype, axes)
    if axes == 1:
        @wp.func_native(snippet)
        def load(values: wp.array(dtype=kind), p: int) -> kind: ...
    elif axes == 2:
        @wp.func_native(snippet)
        def load(values: wp.array2d(dtype=kind), row: int, p: int) -> kind: ...
    else:
        @wp.func_native(snippet)
        def load(values: wp.array3d(dtype=kind), plane: int, row: int, p: int) -> kind: ...
    return load


@once
def pack_store(pack: int, dtype: type, axes: int = 2) -> Any:
    """Return the Warp function that stores a pack of `pack` values of `dtype` in an array of one to three axes."""
    kind = pack_type(pack, dtype)
    snippet = _snippet(STORE, "    *{place} = x;\n", pack, dtype, axes)
    if axes == 1:
        @wp.func_native(snippet)
        def store(values: wp.array(dtype=kind), p: int, x: kind): ...
    elif axes == 2:
        @wp.func_native(snippet)
        def store(values: wp.array2d(dtype=kind), row: int, p: int, x: kind): ...
    else:
        @wp.func_native(snippet)
        def store(values: wp.array3d(dtype=kind), plane: int, row: int, p: int, x: kind): ...
    return store


def _snippet(wide: str, plain: str, pack: int, dtype: type, axes: int) -> str:
    """Return the body of a function for packs of this length: the wide one if CUDA has a word of their size."""
    size = pack * wp.types.type_size_in_bytes(dtype)
    text = wide if size in WORDS else plain
    return text.format(bytes=size, pack=pack, scalar=dtype.__name__, word=WORDS.get(size), place=PLACES[axes])
