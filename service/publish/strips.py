"""Pixels of several pictures, which come in the order of their rows, gathered into strips of whole rows for their pyramids."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from types import TracebackType

import numpy as np

from kernels import device as devices
from service.publish.pyramid import TILE, Pyramid


class Strips(AbstractContextManager["Strips"]):
    """Gives pyramids their rows; pixels that never come have the background."""

    def __init__(self, rows: int, cols: int, pyramids: Sequence[Pyramid], background: np.ndarray) -> None:
        """Begin pictures of [rows, cols] pixels; `background` is [pictures, 3] uint8."""
        self._rows, self._cols, self._pyramids = rows, cols, pyramids
        self._background = background[:, None, :]
        self._strip = np.empty((len(pyramids), TILE * cols, 3), dtype=np.uint8)
        self._strip[:] = self._background
        self._row = 0
        self._pool = ThreadPoolExecutor(devices.worker_count(), thread_name_prefix="relit-publish")

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """Write the rest, unless something failed."""
        try:
            if kind is None:
                while self._row < self._rows:
                    self._flush()
                list(self._pool.map(Pyramid.close, self._pyramids))
        finally:
            self._pool.shutdown(wait=True, cancel_futures=True)

    def put(self, start: int, pixels: np.ndarray) -> None:
        """Take [pictures, pixels, 3] uint8 from a pixel on, which lies behind all that came before."""
        while pixels.shape[1] > 0:
            begin = start - self._row * self._cols
            if begin >= TILE * self._cols:
                self._flush()
                continue
            part = pixels[:, :TILE * self._cols - begin]
            self._strip[:, begin:begin + part.shape[1]] = part
            start, pixels = start + part.shape[1], pixels[:, part.shape[1]:]

    def _flush(self) -> None:
        rows = min(TILE, self._rows - self._row)
        strip = self._strip.reshape(len(self._pyramids), TILE, self._cols, 3)[:, :rows].copy()  # small zooms may keep theirs
        list(self._pool.map(lambda pyramid, part: pyramid.append(part), self._pyramids, strip))
        self._strip[:] = self._background
        self._row += rows
