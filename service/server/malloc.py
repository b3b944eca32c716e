"""Settings of the C library that decide when freed memory goes back to the system."""

import ctypes

TRIM_THRESHOLD, MMAP_THRESHOLD = -1, -3
"""Numbers of the parameters M_TRIM_THRESHOLD and M_MMAP_THRESHOLD of mallopt(3)."""
KEPT_BYTES = 16 << 20
"""Bytes of freed memory that the process keeps for its next allocations."""
LARGE_BYTES = 4 << 20
"""A block of this many bytes or more is mapped alone, and goes back to the system when it is freed."""


def keep_freed_blocks() -> None:
    """Keep the memory that an upload frees after each block that it reads, for its next block.

    By default glibc returns this memory to the system and requests it again page by page, which took 1.5 of the 2 seconds that the API
    worked for 1 GiB. Other C libraries have no such parameter and stay as they are.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(TRIM_THRESHOLD, KEPT_BYTES)
        mallopt(MMAP_THRESHOLD, LARGE_BYTES)
