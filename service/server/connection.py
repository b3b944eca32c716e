"""A connection of a client: HTTP/1.1 as uvicorn speaks it, read in larger pieces."""

import asyncio

from uvicorn.protocols.http.h11_impl import H11Protocol

READ_BYTES = 1 << 20
"""At once: with the 256 KiB of asyncio an upload takes a quarter longer."""


class Connection(H11Protocol):
    """What uvicorn makes for every client."""

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Take a client up."""
        if hasattr(transport, "max_size"):  # of asyncio's own loop, which has no other way to say it
            transport.max_size = READ_BYTES
        super().connection_made(transport)
