"""Report the progress of a command or a job, and the time that each stage of it took."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol


class Progress(Protocol):
    """Receives the stages of a work and the steps of each: the bar of the command line and the worker of a job implement it.

    An implementation must be cheap, because it is called up to a few hundred times a second.
    """

    def stage(self, name: str, total: int) -> None:
        """Begin a stage of `total` steps, one or more; the stage before it is finished.

        Work that cannot be counted is a stage of one step, which ends without a call of `advance`.
        """

    def advance(self, done: int) -> None:
        """Take note that `done` steps of the current stage are finished; the number never falls, and ends at the stage's total."""


class Timings:
    """A Progress that measures the seconds of each stage for reports, and passes every call on."""

    def __init__(self, inner: Progress | None = None) -> None:
        self._inner = inner
        self._started: tuple[str, float] | None = None
        self._furthest = 0
        self.seconds: dict[str, float] = {}
        self.parts: dict[str, float] = {}
        """Seconds of the named parts of stages."""

    def stage(self, name: str, total: int) -> None:
        """Begin a stage, and end the one before it."""
        self.close()
        self._started, self._furthest = (name, time.perf_counter()), 0
        if self._inner is not None:
            self._inner.stage(name, total)

    def advance(self, done: int) -> None:
        """Pass the finished steps on."""
        if self._inner is not None:
            self._inner.advance(done)

    def advance_percent(self, fraction: float) -> None:
        """Tell the fraction done of a stage of 100 steps by an iteration that may go back, which is not told."""
        self._furthest = max(self._furthest, round(100 * fraction))
        self.advance(self._furthest)

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        """Time a part of the current stage that recurs: it has seconds of its own, but no line on the terminal."""
        began = time.perf_counter()
        try:
            yield
        finally:
            self.parts[name] = round(self.parts.get(name, 0.0) + time.perf_counter() - began, 6)

    def close(self) -> dict[str, float]:
        """End the last stage, and return the seconds of every stage by its name, rounded to milliseconds."""
        if self._started is not None:
            name, began = self._started
            self.seconds[name] = round(self.seconds.get(name, 0.0) + time.perf_counter() - began, 3)
            self._started = None
        return self.seconds
