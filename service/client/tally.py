"""Bytes of several files at once, told as one stage of progress."""

import threading

from service.reporting.progress import Progress

MIB = 1 << 20


class Tally:
    """Counts in whole MiB, so that progress is told seldom; from several threads."""

    def __init__(self, progress: Progress | None, stage: str, total: int) -> None:
        """Args: progress: told; None: nobody. stage: its name. total: bytes."""
        self._progress, self._done, self._lock = progress, 0, threading.Lock()
        if progress is not None:
            progress.stage(stage, max(1, -(-total // MIB)))

    def add(self, count: int) -> None:
        """Bytes more; fewer, where some have to be done again."""
        with self._lock:
            before, self._done = self._done // MIB, self._done + count
            if self._progress is not None and self._done // MIB != before:
                self._progress.advance(self._done // MIB)
