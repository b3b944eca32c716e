"""A name for every request, in its answer and in every line of the log that it causes."""

import secrets
import time

import structlog
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.log import logger

HEADER = b"x-request-id"


class Trace:
    """ASGI middleware."""

    def __init__(self, app: ASGIApp) -> None:
        """Args: app: inside."""
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Name the request, pass it on, and log how it went."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        request_id = secrets.token_hex(8)
        scope.setdefault("state", {})["request_id"] = request_id
        structlog.contextvars.clear_contextvars()
        structlog.contextvars.bind_contextvars(request=request_id)
        began, status = time.perf_counter(), 0

        async def tell(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
                message["headers"] = [*message.get("headers", []), (HEADER, request_id.encode())]
            await send(message)

        try:
            await self._app(scope, receive, tell)
        finally:
            logger.info("request", method=scope["method"], path=scope["path"], status=status,
                        ms=round(1e3 * (time.perf_counter() - began), 1))
