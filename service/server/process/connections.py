"""Connections of clients: how many may be open, and how long each may take to send a request and to take its answer.

uvicorn limits the time between two requests and nothing else: a request that is never sent whole, or an answer that is never read, would
hold a connection for ever, and its `limit_concurrency` refuses everybody once it is reached. Here a connection that waits for a request
gives way to a new one when the bound is reached, the one that has waited longest first, as nginx does it with its keep-alive connections:
whoever sends requests whole is served however many others send none.
"""

import asyncio
import resource
from collections import Counter
from typing import Any, NamedTuple

from uvicorn.protocols.http.h11_impl import H11Protocol

from service.server.base.log import logger
from service.server.base.settings import Settings

READ_BYTES = 1 << 20
"""Bytes read from a connection at once: with the 256 KiB of asyncio an upload takes a quarter longer."""
HEADER_S = 10.0
"""Seconds from the beginning of a connection, or from an answer, until the header of the next request must be complete."""
STALL_S = 60.0
"""Seconds in which a client must take STALL_BYTES of the bytes that wait for it."""
STALL_BYTES = 32_768
OWN_DESCRIPTORS = 256
"""Descriptors that are kept for files, the database and the object store."""
AT_ONCE = 32
"""Connections accepted in one turn of the event loop: with the 2048 of uvicorn a flood of them keeps all others waiting for a second."""
BACKLOG = 2048
"""Connections that may wait to be accepted, in the system."""
MAX_CONNECTIONS = 8192
"""Connections at most unless `max_connections` says otherwise: each takes about 20 KB."""
REFUSAL = (b"HTTP/1.1 503 Service Unavailable\r\nContent-Type: text/plain\r\nRetry-After: 5\r\nConnection: close\r\n"
           b"Content-Length: 27\r\n\r\ntoo many open connections\r\n")


class ConnectionLimits(NamedTuple):
    """Bounds of one process."""

    connections: int
    of_address: int
    """Connections of one address at most."""


def raise_descriptors() -> int:
    """Raise the limit on open files to what the system allows this process, and return it."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft != hard:
        try:
            resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
        except (ValueError, OSError):  # a system that allows less than it says
            return soft
    return hard if hard != resource.RLIM_INFINITY else MAX_CONNECTIONS + AT_ONCE + OWN_DESCRIPTORS


def limits_of(settings: Settings, descriptors: int) -> ConnectionLimits:
    """Return the bounds of a process that may open this many descriptors; fewer connections than the settings ask for are logged."""
    room = max(16, descriptors - AT_ONCE - OWN_DESCRIPTORS)  # asyncio accepts before any bound is looked at
    asked = settings.max_connections or MAX_CONNECTIONS
    if settings.max_connections is not None and settings.max_connections > room:
        logger.warning("fewer connections than max_connections: raise LimitNOFILE", connections=room, descriptors=descriptors)
    connections = min(asked, room)
    return ConnectionLimits(connections, min(settings.max_address_connections or connections // 2, connections))


class Connections:
    """The open connections of this process. Everything runs in the event loop."""

    def __init__(self, limits: ConnectionLimits) -> None:
        self._limits = limits
        self._count = 0
        self._of_address: Counter[str] = Counter()
        self._waiting: dict[GuardedConnection, None] = {}  # for a request, the longest first
        self._waiting_of: dict[str, dict[GuardedConnection, None]] = {}

    def __len__(self) -> int:
        """Return the number of open connections."""
        return self._count

    def enter(self, connection: "GuardedConnection") -> bool:
        """Count a new connection; return False if there is no room, and none that waits could be closed for it."""
        address = connection.address
        if self._of_address[address] >= self._limits.of_address:
            candidates = self._waiting_of.get(address, {})
        elif self._count >= self._limits.connections:
            candidates = self._waiting
        else:
            candidates = None
        if candidates is not None:
            oldest = next(iter(candidates), None)
            logger.warning("too many connections", open=self._count, address=address, closed="new" if oldest is None else "longest idle")
            if oldest is None:
                return False
            oldest.drop()
        self._count += 1
        self._of_address[address] += 1
        return True

    def leave(self, connection: "GuardedConnection") -> None:
        """Forget a connection that was counted."""
        self.work(connection)
        self._count -= 1
        self._of_address[connection.address] -= 1
        if not self._of_address[connection.address]:
            del self._of_address[connection.address]

    def wait(self, connection: "GuardedConnection") -> None:
        """Record that a connection waits for a request."""
        self._waiting[connection] = self._waiting_of.setdefault(connection.address, {})[connection] = None

    def work(self, connection: "GuardedConnection") -> None:
        """Record that a request of a connection is being answered."""
        self._waiting.pop(connection, None)
        waiting = self._waiting_of.get(connection.address, {})
        waiting.pop(connection, None)
        if not waiting:
            self._waiting_of.pop(connection.address, None)


class GuardedConnection(H11Protocol):
    """A connection of a client: HTTP/1.1 as uvicorn speaks it, within bounds."""

    def __init__(self, connections: Connections, **of_uvicorn: Any) -> None:
        super().__init__(**of_uvicorn)
        self._all = connections
        self._entered = False
        self._deadline: asyncio.TimerHandle | None = None  # for the header of a request
        self._stalled: asyncio.TimerHandle | None = None
        self._untaken = 0  # bytes of the last answer that its client had not taken at the last deadline
        self.address = ""

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Take the connection, if there is room."""
        if hasattr(transport, "max_size"):  # of asyncio's own loop, which has no public way to set it
            transport.max_size = READ_BYTES
        super().connection_made(transport)
        self.address = self.client[0] if self.client else ""
        self._entered = self._all.enter(self)
        if self._entered:
            self._expect_request()
        else:
            transport.write(REFUSAL)
            self.drop(at_once=False)

    def connection_lost(self, exc: Exception | None) -> None:
        """Forget the connection."""
        self._leave()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Read bytes of a request, unless the connection is to close."""
        if not self.transport.is_closing():
            super().data_received(data)

    def handle_events(self) -> None:
        """Read requests; once one is complete up to its body, its answer may take any time."""
        super().handle_events()
        if self._deadline is not None and self.cycle is not None and not self.cycle.response_complete:
            self._deadline.cancel()
            self._deadline = None
            self._all.work(self)

    def on_response_complete(self) -> None:
        """Wait for the next request."""
        self._expect_request()
        super().on_response_complete()  # which may begin to answer a request that has come already

    def pause_writing(self) -> None:
        """Wait for a client that takes its answer slowly, but not for ever."""
        super().pause_writing()
        self._watch_writing()

    def resume_writing(self) -> None:
        """Go on: the client has taken what waited for it."""
        super().resume_writing()
        if self._stalled is not None:
            self._stalled.cancel()
            self._stalled = None

    def drop(self, *, at_once: bool = True) -> None:
        """Close the connection, and forget it now, not when its socket is closed."""
        self._leave()
        if at_once:
            self.transport.abort()
        else:
            self.transport.close()

    def _expect_request(self) -> None:
        if self._entered:
            if self._deadline is not None:
                self._deadline.cancel()
            self._untaken = self.transport.get_write_buffer_size() + 1
            self._deadline = self.loop.call_later(HEADER_S, self._late)
            self._all.wait(self)

    def _late(self) -> None:
        """Close the connection, unless its client still takes the end of the last answer."""
        left = self.transport.get_write_buffer_size()
        if 0 < left < self._untaken:
            self._untaken = left
            self._deadline = self.loop.call_later(HEADER_S, self._late)
        else:
            self.drop()

    def _watch_writing(self) -> None:
        before = self.transport.get_write_buffer_size()

        def look() -> None:
            if before - self.transport.get_write_buffer_size() < STALL_BYTES:
                self.drop()
            else:
                self._watch_writing()

        self._stalled = self.loop.call_later(STALL_S, look)

    def _leave(self) -> None:
        for timer in (self._deadline, self._stalled):
            if timer is not None:
                timer.cancel()
        self._deadline = self._stalled = None
        if self._entered:
            self._entered = False
            self._all.leave(self)
