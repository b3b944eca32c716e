"""How a pipeline says where it is; the doors decide how to show it."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol


class Progress(Protocol):
    """Told of every stage and step. Implementations must be cheap: they are called up to a few hundred times a second."""

    def stage(self, name: str, total: int) -> None:
        """A stage of `total` steps begins; the one before it is done."""

    def advance(self, done: int) -> None:
        """`done` steps of the current stage are finished."""


class Timings:
    """A Progress that passes everything on and keeps the seconds of each stage, for reports."""

    def __init__(self, inner: Progress | None = None) -> None:
        """Args: inner: told of everything too; None: nobody."""
        self._inner = inner
        self._started: tuple[str, float] | None = None
        self.seconds: dict[str, float] = {}
        self.parts: dict[str, float] = {}
        """Seconds of named parts of stages."""

    def stage(self, name: str, total: int) -> None:
        """Begin a stage."""
        self.close()
        self._started = (name, time.perf_counter())
        if self._inner is not None:
            self._inner.stage(name, total)

    def advance(self, done: int) -> None:
        """Pass on."""
        if self._inner is not None:
            self._inner.advance(done)

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        """Time a part of the current stage that comes again and again: it has seconds of its own, but no line on the terminal."""
        began = time.perf_counter()
        try:
            yield
        finally:
            self.parts[name] = round(self.parts.get(name, 0.0) + time.perf_counter() - began, 6)

    def close(self) -> dict[str, float]:
        """End the last stage.

        Returns:
            Seconds by stage so far, rounded to milliseconds.
        """
        if self._started is not None:
            name, began = self._started
            self.seconds[name] = round(self.seconds.get(name, 0.0) + time.perf_counter() - began, 3)
            self._started = None
        return self.seconds
