"""How the process gets its memory from the system."""

import ctypes

TRIM_THRESHOLD, MMAP_THRESHOLD = -1, -3
"""Of mallopt(3)."""
KEPT_BYTES = 16 << 20
"""Freed memory that is kept for what comes next."""
LARGE_BYTES = 4 << 20
"""From here on a block is got for itself and given back when it is freed."""


def keep_freed_blocks() -> None:
    """Keep what an upload frees with every block that it has read, for its next block.

    glibc gives it back to the system and gets it again page by page, which took 1.5 of the 2 seconds that the API worked for 1 GiB. Other
    C libraries have no such switch, and are left as they are.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(TRIM_THRESHOLD, KEPT_BYTES)
        mallopt(MMAP_THRESHOLD, LARGE_BYTES)
