"""Settings of the C library for the memory of the API process."""

import ctypes

TRIM_THRESHOLD, MMAP_THRESHOLD, ARENA_MAX = -1, -3, -8
"""Numbers of the parameters M_TRIM_THRESHOLD, M_MMAP_THRESHOLD and M_ARENA_MAX of mallopt(3)."""
KEPT_BYTES = 16 << 20
"""Bytes of freed memory that the process keeps for its next allocations."""
LARGE_BYTES = 4 << 20
"""A block of this many bytes or more is mapped alone, and goes back to the system when it is freed."""


def keep_freed_blocks() -> None:
    """Keep the memory that an upload frees after each block that it reads, for its next block.

    By default glibc returns this memory to the system and requests it again page by page, which took 1.5 of the 2 seconds that the API
    worked for 1 GiB. Other C libraries have no such parameter and stay as they are.
    """
    _set(TRIM_THRESHOLD, KEPT_BYTES)
    _set(MMAP_THRESHOLD, LARGE_BYTES)


def share_one_arena() -> None:
    """Let all threads allocate from one arena; to be called before there are several.

    By default glibc gives up to eight arenas for each core to threads as they come. Threads of the pool end when they are idle, and the
    next one goes on in another arena, so that each arena grows until it has once held the most that a request needs: the API grew by some
    percent in ten minutes of an even load. One arena costs little, as mostly the one thread allocates that holds the interpreter.
    """
    _set(ARENA_MAX, 1)


def _set(parameter: int, value: int) -> None:
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(parameter, value)
