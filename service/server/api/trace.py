"""A name for every request, in its answer and in every line of the log that it causes; and its place in the numbers of /metrics."""

import secrets
import time

import structlog
from fastapi import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.server.api.metrics import Metrics
from service.server.api.problems import answer
from service.server.log import logger

HEADER = b"x-request-id"
QUIET = ("/healthz", "/readyz", "/metrics")
"""Asked every few seconds for ever: logged at the level debug."""


class Trace:
    """ASGI middleware."""

    def __init__(self, app: ASGIApp, metrics: Metrics) -> None:
        """Args: app: inside. metrics: that count."""
        self._app, self._metrics = app, metrics

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Name the request, pass it on, and log how it went."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        request_id = secrets.token_hex(8)
        scope.setdefault("state", {})["request_id"] = request_id
        structlog.contextvars.clear_contextvars()
        structlog.contextvars.bind_contextvars(request=request_id)
        began, status, waited, received = time.perf_counter(), 0, 0.0, 0

        async def tell(message: Message) -> None:
            nonlocal status, waited
            if message["type"] == "http.response.start":
                status, waited = message["status"], time.perf_counter() - began
                message["headers"] = [*message.get("headers", []), (HEADER, request_id.encode())]
            await send(message)

        async def hear() -> Message:
            nonlocal received
            message = await receive()
            received += len(message.get("body", b""))
            return message

        self._metrics.running.inc()
        try:
            await self._app(scope, hear, tell)
        except Exception as error:
            logger.error("request failed", exc_info=error)
            if status == 0:
                problem = answer(Request(scope), "internal", "an error of relit itself: the log has more under this request_id")
                await problem(scope, receive, tell)
        finally:
            self._metrics.running.dec()
            self._metrics.count(scope, status, waited, received)
            log = logger.debug if scope["path"] in QUIET else logger.info
            caller, problem = scope["state"].get("caller"), scope["state"].get("problem")
            log("request", method=scope["method"], path=scope["path"], status=status, ms=round(1e3 * (time.perf_counter() - began), 1),
                client=scope["client"][0] if scope.get("client") else None, **({} if problem is None else {"problem": problem}),
                **({} if caller is None else {
                    "project": caller.project, "key": caller.key}))
