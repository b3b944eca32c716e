"""A server of HTTP on this machine that answers as a test wants."""

import ssl
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import NamedTuple


class Asked(NamedTuple):
    """A request."""

    path: str
    headers: dict[str, str]
    """By their names in small letters."""
    body: bytes


@contextmanager
def answering(answer: Callable[[Asked], tuple[int, bytes]], *, host: str = "127.0.0.1", port: int = 0, tls: ssl.SSLContext | None = None,
              **headers: str) -> Iterator[str]:
    """Yield the address of a server that answers GET and POST with the status and the body that `answer` gives, and these headers."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            sent = {name.lower(): value for name, value in self.headers.items()}
            status, body = answer(Asked(self.path, sent, self.rfile.read(int(sent.get("content-length", 0)))))
            self.send_response(status)
            for name, value in ({"Content-Length": str(len(body))} | headers).items():
                self.send_header(name, value)
            self.end_headers()
            self.wfile.write(body)

        do_POST = do_GET

        def log_message(self, *_: object) -> None:
            pass

    server = ThreadingHTTPServer((host, port), Handler)
    server.daemon_threads = True
    if tls is not None:
        server.socket = tls.wrap_socket(server.socket, server_side=True)
    threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.05}, daemon=True).start()
    try:
        yield f"http://{host}:{server.server_address[1]}"
    finally:
        server.shutdown()
        server.server_close()
