"""A client of the service for Python programs; docs/python_client.md explains its use."""

from collections.abc import Callable
from types import TracebackType
from typing import Self

import httpx2

from service.client.connection import Connection
from service.client.errors import (
    Busy,
    ClientError,
    Conflict,
    Faulty,
    FileError,
    IntakeRefused,
    Invalid,
    JobEnded,
    NotAllowed,
    NotFound,
    Refused,
    Unreachable,
)
from service.client.intakes import Annotations, Intakes
from service.client.jobs import Hooks, Jobs
from service.requests.base.identifiers import DEFAULT_SERVER

__all__ = ["Busy", "Client", "ClientError", "Conflict", "Faulty", "FileError", "IntakeRefused", "Invalid", "JobEnded", "NotAllowed",
           "NotFound", "Refused", "Unreachable"]


class Client:
    """Uploads captures, submits jobs and downloads their results; several threads may use one client."""

    def __init__(self, server: str = DEFAULT_SERVER, key: str | None = None, *, patience_s: float = 120.0, timeout_s: float = 60.0,
                 parallel: int = 4, transport: httpx2.BaseTransport | None = None,
                 on_silence: Callable[[str], None] | None = None) -> None:
        """Prepare the client; nothing is sent yet.

        Args:
            server: URL of the service, with or without /v1.
            key: made by `relit keys create`; None: the service must allow requests without a key.
            patience_s: how long a request is repeated while the service does not answer or asks to wait; for an upload or a download,
                counted from the last bytes that arrived.
            timeout_s: how long to wait for a connection, or for the next bytes.
            parallel: number of files that are sent or fetched at once.
            transport: an httpx2 transport, for a proxy, a certificate authority or a socket; None: httpx2's default.
            on_silence: told, once, with a sentence when the service first does not answer a request that is then repeated.
        """
        self._connection = Connection(server, key, patience_s=patience_s, timeout_s=timeout_s, transport=transport, on_silence=on_silence)
        self.captures = Intakes(self._connection, "/v1/captures", "folder", parallel=parallel)
        self.environments = Intakes(self._connection, "/v1/environments", "file", parallel=parallel)
        self.annotations = Annotations(self._connection)
        self.jobs = Jobs(self._connection, parallel=parallel)
        self.hooks = Hooks(self._connection)

    def close(self) -> None:
        """Close the connections to the service."""
        self._connection.http.close()

    def __enter__(self) -> Self:
        """Return this client."""
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """Close the client."""
        self.close()
