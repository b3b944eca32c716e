"""Settings of the C library for the memory of the API process."""

import ctypes
import os
import sys
from contextlib import suppress

TRIM_THRESHOLD, MMAP_THRESHOLD, ARENA_MAX = -1, -3, -8
"""Numbers of the parameters M_TRIM_THRESHOLD, M_MMAP_THRESHOLD and M_ARENA_MAX of mallopt(3)."""
KEPT_BYTES = 16 << 20
"""Bytes of freed memory that the process keeps for its next allocations."""
LARGE_BYTES = 4 << 20
"""A block of this many bytes or more is mapped alone, and goes back to the system when it is freed."""

TUNABLES, THREAD_CACHE = "GLIBC_TUNABLES", "glibc.malloc.tcache_count"
"""The variable from which glibc reads its settings when a program starts, and the setting that says how many freed blocks of each size a
thread keeps (https://sourceware.org/glibc/manual/latest/html_node/Memory-Allocation-Tunables.html)."""
NO_THREAD_CACHES = f"{THREAD_CACHE}=0"
RESTARTED = "_RELIT_RESTARTED"
"""The variable that names the process that has started its program again. A system may take TUNABLES away from a program, as from one that
has capabilities of its own; without RESTARTED this program would start again for ever."""


def restart_without_thread_caches() -> None:
    """Start the program of this process again, with the same arguments, so that no thread keeps freed memory for itself alone.

    By default each thread of glibc keeps the last blocks of each of 64 sizes that it has freed, 236 KB at most. These caches fill slowly in
    threads that serve a request now and then: with those of the pool, the API grew by one percent in ten minutes of an even load. glibc has
    no function that ends them in a program that runs. The process stays the same, and programs that it starts later have their caches.

    Nothing happens with another C library, if TUNABLES has a value of THREAD_CACHE already, or if this process was started by another
    command line than the one that it has now, as a test that calls a command.
    """
    given = os.environ.get(TUNABLES, "")
    if os.environ.pop(RESTARTED, "") == str(os.getpid()):
        os.environ.pop(TUNABLES, None)
        if before := given.removesuffix(NO_THREAD_CACHES).removesuffix(":"):
            os.environ[TUNABLES] = before
        return
    arguments = sys.argv[1:]
    if not _is_glibc() or THREAD_CACHE in given or sys.orig_argv[len(sys.orig_argv) - len(arguments):] != arguments:
        return
    tunables = f"{given}:{NO_THREAD_CACHES}" if given else NO_THREAD_CACHES
    with suppress(OSError):  # a system that starts no program from this one: the caches stay
        os.execve(sys.executable, [sys.executable, *sys.orig_argv[1:]],
                  os.environ | {TUNABLES: tunables, RESTARTED: str(os.getpid())})


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


def _is_glibc() -> bool:
    try:
        return (os.confstr("CS_GNU_LIBC_VERSION") or "").startswith("glibc")
    except ValueError:  # a system that does not know the name
        return False


def _set(parameter: int, value: int) -> None:
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(parameter, value)
