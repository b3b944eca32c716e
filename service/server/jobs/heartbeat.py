"""Signs of life that a worker process gives its supervisor, in memory that both processes share.

The memory has no lock: a worker that is killed while it holds one would stop the supervisor for ever. Each sign is one aligned double.
"""

import time
from multiprocessing.sharedctypes import RawArray
from typing import Any

READY, BEAT, STEP = range(3)


class Heartbeat:
    """Times of the last signs of one worker process, in monotonic seconds, which are the same in all processes of a machine."""

    def __init__(self) -> None:
        self._signs: Any = RawArray("d", 3)
        self._signs[BEAT] = time.monotonic()

    def ready(self) -> None:
        """Record that the worker has started and takes jobs."""
        self._signs[READY] = time.monotonic()

    @property
    def was_ready(self) -> bool:
        """Whether the worker ever took jobs."""
        return bool(self._signs[READY] > 0)

    def beat(self) -> None:
        """Record that the worker is alive, whether or not a step runs."""
        self._signs[BEAT] = time.monotonic()

    def step(self, oldest: float) -> None:
        """Record the time of the oldest last sign of progress of the running steps; 0: no step runs."""
        self._signs[STEP] = oldest

    @property
    def silent_s(self) -> float:
        """Seconds for which the worker or a running step has given no sign."""
        return float(time.monotonic() - min(self._signs[BEAT], self._signs[STEP] or self._signs[BEAT]))
