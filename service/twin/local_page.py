"""Pages that a command serves to browsers on this machine while it runs."""

import socket

from service.errors import RequestError

HEADERS = {"Cache-Control": "no-store", "X-Content-Type-Options": "nosniff",
           "Content-Security-Policy": "default-src 'self'; style-src 'self' 'unsafe-inline'; frame-ancestors 'none'"}
"""The headers of all answers: nothing is kept, and nothing is loaded from elsewhere."""


def page_socket(port: int, option: str) -> socket.socket:
    """Return a socket that listens on the loopback. `port`: 0: any free one. Raises RequestError if the port cannot be used."""
    try:
        return socket.create_server(("127.0.0.1", port))
    except OSError as error:
        raise RequestError(f"{option} {port}: cannot serve the page: {(error.strerror or str(error)).lower()}") from error


def page_address(listening: socket.socket) -> str:
    """Return the address of the page that is served on a socket."""
    return "http://{}:{}".format(*listening.getsockname())
