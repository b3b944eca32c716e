"""Signs of life that a worker gives the process that looks after it, in memory that both share.

Without a lock: a worker that is killed while it holds one would stop the other for ever. Each sign is one aligned double.
"""

import time
from multiprocessing.sharedctypes import RawArray
from typing import Any

READY, BEAT, STEP = range(3)


class Heartbeat:
    """Times (monotonic seconds) of one worker process; they are those of the machine, so that both processes read them alike."""

    def __init__(self) -> None:
        self._signs: Any = RawArray("d", 3)
        self._signs[BEAT] = time.monotonic()

    def ready(self) -> None:
        """The worker has started well."""
        self._signs[READY] = time.monotonic()

    @property
    def was_ready(self) -> bool:
        """Whether it ever did."""
        return bool(self._signs[READY] > 0)

    def beat(self) -> None:
        """The worker as a whole goes on."""
        self._signs[BEAT] = time.monotonic()

    def step(self, oldest: float) -> None:
        """The oldest last sign of progress of the running steps; 0: none runs."""
        self._signs[STEP] = oldest

    @property
    def silent_s(self) -> float:
        """For how long the worker as a whole, or a running step, has given no sign."""
        return float(time.monotonic() - min(self._signs[BEAT], self._signs[STEP] or self._signs[BEAT]))
