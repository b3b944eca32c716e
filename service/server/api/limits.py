"""Limits of each API process, in its memory: how often a key may ask, and how much of a kind may be under way at once.

A service of several API processes behind one address allows as many times these limits. nginx can hold them over all processes, as
docs/service.md shows.
"""

import math
import threading
import time
from collections import Counter
from collections.abc import Callable
from typing import NoReturn

from service.server.api.problems import RETRY_S, ApiError

FORGET_ABOVE = 10_000
"""Number of buckets above which the full ones are dropped, since a full bucket is like a new one."""
CREATION_COST = 10
"""Tokens that a new capture or environment takes: each leaves rows in the database, also after it is deleted."""


class RateLimiter:
    """A token bucket for each key, in this process."""

    def __init__(self, per_second: float, burst: int, *, clock: Callable[[], float] = time.monotonic) -> None:
        self._per_second, self._burst, self._clock = per_second, burst, clock
        self._buckets: dict[str | None, tuple[float, float]] = {}  # tokens, and when they were counted
        self._lock = threading.Lock()

    def __len__(self) -> int:
        """Return the number of buckets."""
        return len(self._buckets)

    def take(self, key: str | None, cost: int = 1) -> None:
        """Take `cost` tokens from the bucket of a key, or all that it holds if that is less; refuse if there are fewer in it."""
        now, cost = self._clock(), min(cost, self._burst)
        with self._lock:
            tokens = self._tokens(key, now)
            if tokens >= cost:
                self._buckets[key] = (tokens - cost, now)
                if len(self._buckets) > FORGET_ABOVE:
                    self._buckets = {key: bucket for key, bucket in self._buckets.items() if self._tokens(key, now) < self._burst}
                return
        self._refuse(tokens, cost)

    def require(self, key: str | None) -> None:
        """Refuse a key whose bucket is empty, and take nothing; whether the key is right need not be known."""
        if key in self._buckets and (tokens := self._tokens(key, self._clock())) < 1:
            self._refuse(tokens, 1)

    def _tokens(self, key: str | None, now: float) -> float:
        tokens, counted = self._buckets.get(key, (float(self._burst), now))
        return min(float(self._burst), tokens + (now - counted) * self._per_second)

    def _refuse(self, tokens: float, cost: int) -> NoReturn:
        wait = math.ceil((cost - tokens) / self._per_second)
        raise ApiError("too-many", f"the key asks more than {self._per_second:g} times a second", headers={"Retry-After": str(wait)})


class AtOnce:
    """Counts what each holder (a key or a project) has under way in this process. Everything runs in the event loop."""

    def __init__(self, most: int, what: str) -> None:
        self._most, self._what = most, what
        self._running: Counter[str | None] = Counter()

    def enter(self, holder: str | None) -> None:
        """Count one more, which `leave` must end; refuse a holder that has as many as it may."""
        if self._running[holder] >= self._most:
            raise ApiError("too-many", f"{self._most} {self._what}", headers={"Retry-After": str(RETRY_S)})
        self._running[holder] += 1

    def leave(self, holder: str | None) -> None:
        """Count one less."""
        self._running[holder] -= 1
        if not self._running[holder]:
            del self._running[holder]
