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


def until(look: Callable[[], T], what: str = "nothing came", *, within_s: float = PATIENCE_S, every_s: float = 0.02) -> T:
    """Look again and again until there is something, and return it."""
    deadline = time.monotonic() + within_s
    while not (found := look()):
        assert time.monotonic() < deadline, what
        time.sleep(every_s)
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
