"""How fast a key may ask: a bucket of tokens for each, in this process."""

import math
import threading
import time
from collections.abc import Callable

from service.server.api.problems import ApiError

FORGET_ABOVE = 10_000
"""Buckets that are kept; full ones say nothing and go first."""


class Limiter:
    """Token buckets by key."""

    def __init__(self, per_second: float, burst: int, *, clock: Callable[[], float] = time.monotonic) -> None:
        """Args: per_second: that a bucket gains. burst: that it holds. clock: seconds."""
        self._per_second, self._burst, self._clock = per_second, burst, clock
        self._buckets: dict[str | None, tuple[float, float]] = {}  # tokens, when they were counted
        self._lock = threading.Lock()

    def __len__(self) -> int:
        """Buckets that are kept."""
        return len(self._buckets)

    def take(self, key: str | None) -> None:
        """Take a token of a key.

        Raises:
            ApiError: there is none left.
        """
        now = self._clock()
        with self._lock:
            tokens, counted = self._buckets.get(key, (float(self._burst), now))
            tokens = min(float(self._burst), tokens + (now - counted) * self._per_second)
            if tokens >= 1:
                self._buckets[key] = (tokens - 1, now)
                if len(self._buckets) > FORGET_ABOVE:
                    self._forget(now)
                return
        wait = math.ceil((1 - tokens) / self._per_second)
        raise ApiError("too-many", f"the key asks more than {self._per_second:g} times a second", headers={"Retry-After": str(wait)})

    def _forget(self, now: float) -> None:
        self._buckets = {key: (tokens, counted) for key, (tokens, counted) in self._buckets.items()
                         if tokens + (now - counted) * self._per_second < self._burst}
