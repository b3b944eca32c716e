"""Waiting for something, calls that are made at the same moment, and free ports."""

import socket
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

T = TypeVar("T")
PATIENCE_S = 60.0
"""Far beyond what anything takes, so that a slow machine fails no test."""
FIRST_LOOK_S, LAST_LOOK_S = 0.02, 0.25
"""Seconds between two looks at something, at first and after some seconds."""


def until(look: Callable[[], T], what: str = "nothing came", *, within_s: float = PATIENCE_S, every_s: float | None = None) -> T:
    """Look again and again until there is something, and return it.

    Without `every_s` it looks the less often the longer it has waited: a look takes thousandths of a second of a core, here and often in a
    server as well.
    """
    began = time.monotonic()
    while not (found := look()):
        waited = time.monotonic() - began
        assert waited < within_s, what
        time.sleep(every_s or min(FIRST_LOOK_S + waited / 16, LAST_LOOK_S))
    return found


def at_once(count: int, call: Callable[[int], T]) -> list[T]:
    """Make so many calls at the same moment, each with its number."""
    together = threading.Barrier(count)

    def one(number: int) -> T:
        together.wait()
        return call(number)

    with ThreadPoolExecutor(count) as pool:
        return list(pool.map(one, range(count)))


def free_port() -> int:
    """Return a port of the loopback address that nobody listens on."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        return int(server.getsockname()[1])
