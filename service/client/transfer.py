"""Uploads and downloads of several files at once, whose bytes are reported as one progress."""

from collections.abc import Callable, Iterable
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from threading import Event, Lock
from typing import TypeVar

from service.reporting.progress import Progress

Result = TypeVar("Result")
MIB = 1 << 20
PIECE_BYTES = 1 << 20
"""Bytes of a file that are read or written at once."""


class Stopped(Exception):
    """Raised in a transfer because another file of the same call failed."""


class TransferProgress:
    """Reports transferred bytes to a `Progress` in whole MiB; several threads may add to one."""

    def __init__(self, progress: Progress | None, stage: str, total: int) -> None:
        self._progress, self._done, self._lock = progress, 0, Lock()
        if progress is not None:
            progress.stage(stage, max(1, _whole_mib(total)))

    def add(self, count: int) -> None:
        """Add transferred bytes; a negative count takes back bytes that have to be transferred again."""
        with self._lock:
            before, self._done = _whole_mib(self._done), self._done + count
            if self._progress is not None and _whole_mib(self._done) != before:
                self._progress.advance(_whole_mib(self._done))


def _whole_mib(count: int) -> int:
    return -(-count // MIB)


def transfer_all(transfers: Iterable[Callable[[Event], Result]], *, parallel: int) -> list[Result]:
    """Run transfers in `parallel` threads, and return their results in their order; when one fails, stop all and raise its error.

    A transfer raises `Stopped` when the event that it is given is set.
    """
    stop = Event()
    pool = ThreadPoolExecutor(parallel)
    try:
        futures = [pool.submit(transfer, stop) for transfer in transfers]
        done, _ = wait(futures, return_when=FIRST_EXCEPTION)
        for future in done:
            future.result()
        return [future.result() for future in futures]
    finally:  # also after Ctrl-C
        stop.set()
        pool.shutdown(cancel_futures=True)
