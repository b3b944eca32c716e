"""An app asked without a server: paths are sent as they are, and the client can leave when a test wants it to."""

import asyncio
from collections.abc import Callable, Coroutine, Iterator
from contextlib import contextmanager
from functools import cache, wraps
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from urllib.parse import unquote_to_bytes

from fastapi import FastAPI

from service.server.api.app import create_app
from service.server.base.settings import Settings
from tests.service.server.prepared import opened


class Call:
    """One request, and what came of it so far; with `sent` None its body does not come."""

    def __init__(self, app: Any, path: str, *, method: str = "GET", headers: dict[str, str] | None = None,
                 sent: bytes | None = b"") -> None:
        self._app, self.status, self.body, self._sent = app, 0, b"", sent
        self._left = asyncio.Event()
        self._asked = False
        given = {"host": "127.0.0.1", **(headers or {})}
        self._scope = {
            "type": "http", "asgi": {"version": "3.0", "spec_version": "2.3"}, "http_version": "1.1", "method": method, "scheme": "http",
            "path": unquote_to_bytes(path).decode(errors="replace"), "raw_path": path.encode(), "root_path": "", "query_string": b"",
            "headers": [(name.lower().encode(), value.encode()) for name, value in given.items()],
            "client": ("127.0.0.1", 1), "server": ("127.0.0.1", 1)}

    def leave(self) -> None:
        """Close the connection."""
        self._left.set()

    async def run(self) -> "Call":
        """Until it is answered, or the client has left."""
        await self._app(self._scope, self._receive, self._send)
        return self

    async def _receive(self) -> dict[str, Any]:
        if not self._asked and self._sent is not None:
            self._asked = True
            return {"type": "http.request", "body": self._sent, "more_body": False}
        await self._left.wait()
        return {"type": "http.disconnect"}

    async def _send(self, message: dict[str, Any]) -> None:
        if message["type"] == "http.response.start":
            self.status = message["status"]
        else:
            self.body += message.get("body", b"")


@contextmanager
def app_of(settings: Settings) -> Iterator[FastAPI]:
    """The app over a database of its own, in this process and without workers."""
    with opened(settings) as database:
        yield create_app(settings, database)


@cache
def openapi() -> dict[str, Any]:
    """The OpenAPI document, which takes long to make."""
    with TemporaryDirectory() as folder, app_of(Settings(data=Path(folder))) as app:
        return app.openapi()


def asynchronous(test: Callable[..., Coroutine[Any, Any, None]]) -> Callable[..., None]:
    """Run a test that is a coroutine."""
    @wraps(test)
    def run(**fixtures: object) -> None:
        asyncio.run(asyncio.wait_for(test(**fixtures), 120))

    return run
