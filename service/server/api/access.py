"""Two checks of every request: how often its key asks and, if it has no key, whether it comes from a program of this machine."""

import math
import threading
import time
from collections import Counter
from collections.abc import Callable
from typing import NoReturn
from urllib.parse import urlsplit

from fastapi import Request

from service.server.api.problems import RETRY_S, ApiError
from service.server.settings import is_loopback

FORGET_ABOVE = 10_000
"""Number of buckets above which the full ones are dropped, since a full bucket is like a new one."""
FORWARDED = ("forwarded", "x-forwarded-for", "x-forwarded-host", "x-real-ip", "via")
"""Headers that proxies add to a request."""


class RateLimiter:
    """A token bucket for each key, in this process."""

    def __init__(self, per_second: float, burst: int, *, clock: Callable[[], float] = time.monotonic) -> None:
        """Args: per_second: tokens that a bucket gains. burst: tokens that it holds. clock: returns seconds."""
        self._per_second, self._burst, self._clock = per_second, burst, clock
        self._buckets: dict[str | None, tuple[float, float]] = {}  # tokens, and when they were counted
        self._lock = threading.Lock()

    def __len__(self) -> int:
        """Return the number of buckets."""
        return len(self._buckets)

    def take(self, key: str | None) -> None:
        """Take a token from the bucket of a key.

        Raises:
            ApiError: the bucket is empty.
        """
        now = self._clock()
        with self._lock:
            tokens = self._tokens(key, now)
            if tokens >= 1:
                self._buckets[key] = (tokens - 1, now)
                if len(self._buckets) > FORGET_ABOVE:
                    self._forget(now)
                return
        self._refuse(tokens)

    def require(self, key: str | None) -> None:
        """Take nothing from the bucket of a key, of which it need not be known whether it is right.

        Raises:
            ApiError: the bucket is empty.
        """
        if key in self._buckets and (tokens := self._tokens(key, self._clock())) < 1:
            self._refuse(tokens)

    def _tokens(self, key: str | None, now: float) -> float:
        tokens, counted = self._buckets.get(key, (float(self._burst), now))
        return min(float(self._burst), tokens + (now - counted) * self._per_second)

    def _refuse(self, tokens: float) -> NoReturn:
        wait = math.ceil((1 - tokens) / self._per_second)
        raise ApiError("too-many", f"the key asks more than {self._per_second:g} times a second", headers={"Retry-After": str(wait)})

    def _forget(self, now: float) -> None:
        self._buckets = {key: (tokens, counted) for key, (tokens, counted) in self._buckets.items()
                         if tokens + (now - counted) * self._per_second < self._burst}


class RunningRequests:
    """The requests of each key that are under way in this process. Everything runs in the event loop.

    An upload or a download that its client draws out holds a connection and a file, and its connection gives way to no other.
    """

    def __init__(self, most: int) -> None:
        """Args: most: requests of one key."""
        self._most = most
        self._running: Counter[str | None] = Counter()

    def enter(self, key: str | None) -> None:
        """Count a request, which `leave` must end.

        Raises:
            ApiError: as many of the key are under way.
        """
        if self._running[key] >= self._most:
            raise ApiError("too-many", f"{self._most} requests of this key are under way", headers={"Retry-After": str(RETRY_S)})
        self._running[key] += 1

    def leave(self, key: str | None) -> None:
        """End a request."""
        self._running[key] -= 1
        if not self._running[key]:
            del self._running[key]


def require_local(request: Request) -> None:
    """Refuse a request that a program of this machine did not send.

    A page in a browser of this machine can send requests to a loopback address: under its own name, which it has made to point there (the
    Host shows it), or from another site (the Origin shows it).

    Raises:
        ApiError: the request came through a proxy, or from a page of another site.
    """
    host = request.headers.get("host", "")
    if not is_loopback(_name(host)):
        raise ApiError("forbidden", "without a key, the Host must be localhost or a loopback address")
    if any(name in request.headers for name in FORWARDED):
        raise ApiError("forbidden", "without a key, requests through a proxy are refused: make keys with relit keys create")
    origin = request.headers.get("origin")
    if origin is not None and origin not in (f"http://{host}", f"https://{host}"):
        raise ApiError("forbidden", "without a key, requests from pages of other sites are refused")


def _name(host: str) -> str:
    try:
        return urlsplit(f"//{host}").hostname or ""
    except ValueError:
        return ""
