"""The client: one service, one key."""

from types import TracebackType
from typing import Self

import httpx2

from service.client.intakes import Intakes
from service.client.jobs import Jobs
from service.client.link import Link

DEFAULT_SERVER = "http://127.0.0.1:8470"
"""Where `relit serve` listens unless it is told otherwise."""


class Client:
    """Captures in, jobs done, results out, from a program of one's own. May be used from several threads."""

    def __init__(self, server: str = DEFAULT_SERVER, key: str | None = None, *, patience_s: float = 120.0, timeout_s: float = 60.0,
                 parallel: int = 4, transport: httpx2.BaseTransport | None = None) -> None:
        """Prepare; nothing is sent yet.

        Args:
            server: URL of the service, with or without /v1.
            key: of `relit keys create`; None: the service lets in who has none.
            patience_s: how long a request is sent again while the service cannot be reached or asks to wait; an upload, since its last
                progress.
            timeout_s: how long to wait for a connection, or for the next bytes.
            parallel: files that are sent or fetched at once.
            transport: of httpx2, for a proxy, a certificate authority or a socket of one's own; None: the network as it is.

        Raises:
            ClientError: the URL or the key is none.
        """
        self._link = Link(server, key, patience_s=patience_s, timeout_s=timeout_s, transport=transport)
        self.captures = Intakes(self._link, "/v1/captures", "folder", parallel=parallel)
        self.environments = Intakes(self._link, "/v1/environments", "file", parallel=parallel)
        self.jobs = Jobs(self._link, parallel=parallel)

    def close(self) -> None:
        """Let go of the connections."""
        self._link.http.close()

    def __enter__(self) -> Self:
        """Itself."""
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """Close."""
        self.close()
