"""A TCP proxy on loopback that cuts its connections, as a cable that is pulled out does."""

import contextlib
import socket
import threading
import time
from collections.abc import Iterator

from tests.service.waiting import until


class TcpProxy:
    """Passes bytes on to an address, until it is told to cut."""

    def __init__(self, host: str, port: int) -> None:
        self._target = host, port
        self._listening = socket.create_server(("127.0.0.1", 0))
        self.port = self._listening.getsockname()[1]
        self.url = f"http://127.0.0.1:{self.port}"
        self._lock = threading.Lock()
        self._open: set[socket.socket] = set()
        self._budget: int | None = None
        self._budget_away_s = 0.0
        self._away_until = 0.0
        self._damaged = 0
        self.cuts = 0
        """How often connections that were open have been cut."""
        threading.Thread(target=self._accept, daemon=True).start()

    def cut_after(self, count: int, *, away_s: float = 0.0) -> None:
        """Cut all connections once as `cut` does, when so many bytes have passed."""
        with self._lock:
            self._budget, self._budget_away_s = count, away_s

    def cut(self, *, away_s: float = 0.0) -> None:
        """Cut all connections, and refuse new ones for some seconds."""
        with self._lock:
            self._away_until = time.monotonic() + away_s
            there, self._open = self._open, set()
            self.cuts += bool(there)
        for each in there:
            with contextlib.suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)
            each.close()

    def cut_when_open(self, *, away_s: float = 0.0) -> None:
        """Wait for a connection, and cut as `cut` does."""
        def cut() -> int:
            if self._open:
                self.cut(away_s=away_s)
            return self.cuts

        until(cut, "nobody connected")

    def mend(self) -> None:
        """Take new connections again."""
        self._away_until = 0.0

    def damage(self, count: int) -> None:
        """Answer the next connections with bytes that belong to no protocol."""
        with self._lock:
            self._damaged = count

    def close(self) -> None:
        self._listening.close()
        self.cut()

    def _accept(self) -> None:
        while True:
            try:
                client, _ = self._listening.accept()
            except OSError:
                return
            if time.monotonic() < self._away_until:
                client.close()
                continue
            if self._damaged:
                self._damaged -= 1
                client.recv(1)
                client.sendall(b"\0nonsense\r\n\r\n")
                client.close()
                continue
            try:
                server = socket.create_connection(self._target)
            except OSError:
                client.close()
                continue
            with self._lock:
                self._open |= {client, server}
            for source, sink in ((client, server), (server, client)):
                threading.Thread(target=self._pass, args=(source, sink), daemon=True).start()

    def _pass(self, source: socket.socket, sink: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while piece := source.recv(1 << 14):
                if self._spent(len(piece)):
                    self.cut(away_s=self._budget_away_s)
                    return
                sink.sendall(piece)
        for each in (source, sink):
            with contextlib.suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)
            with self._lock:
                self._open.discard(each)
            each.close()

    def _spent(self, count: int) -> bool:
        with self._lock:
            if self._budget is None:
                return False
            self._budget -= count
            if self._budget > 0:
                return False
            self._budget = None
            return True


@contextlib.contextmanager
def tcp_proxy(port: int, host: str = "127.0.0.1") -> Iterator[TcpProxy]:
    """A proxy to a port."""
    made = TcpProxy(host, port)
    try:
        yield made
    finally:
        made.close()
