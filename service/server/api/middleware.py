"""ASGI middleware around all routes: a limit on bodies of JSON, and for every request an identifier, a line in the log and a metric."""

import secrets
import time

import structlog
from fastapi import Request
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.server.api.metrics import Metrics
from service.server.api.problems import answer
from service.server.base.log import logger

REQUEST_ID = b"x-request-id"
QUIET = ("/healthz", "/readyz", "/metrics", "/set/state")
"""Paths that are asked for every few seconds or more often; their requests are logged at the level debug."""
MAX_BYTES = 1 << 20
"""Most bytes of a JSON body; the light keys of a long film have some hundred kilobytes."""
UPLOADS = "/v1/uploads/"
"""Path of the bodies that are not JSON, which are written to the disk piece by piece."""
TOO_LARGE = f"the body is larger than {MAX_BYTES} bytes"


class RequestLog:
    """Gives every request an identifier, which its answer and its lines in the log carry, and counts it for /metrics."""

    def __init__(self, app: ASGIApp, metrics: Metrics) -> None:
        self._app, self._metrics = app, metrics

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on and log its outcome."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        request_id = secrets.token_hex(8)
        scope.setdefault("state", {})["request_id"] = request_id
        structlog.contextvars.clear_contextvars()
        structlog.contextvars.bind_contextvars(request=request_id)
        began, status, waited, received = time.perf_counter(), 0, 0.0, 0

        async def send_with_id(message: Message) -> None:
            nonlocal status, waited
            if message["type"] == "http.response.start":
                status, waited = message["status"], time.perf_counter() - began
                message["headers"] = [*message.get("headers", []), (REQUEST_ID, request_id.encode())]
            await send(message)

        async def counted() -> Message:
            nonlocal received
            message = await receive()
            received += len(message.get("body", b""))
            return message

        self._metrics.running.inc()
        try:
            await self._app(scope, counted, send_with_id)
        except Exception as error:
            logger.error("request failed", exc_info=error)
            if status == 0:
                problem = answer(Request(scope), "internal", "an error of relit itself: the log has more under this request_id")
                await problem(scope, receive, send_with_id)
        finally:
            self._metrics.running.dec()
            self._metrics.count(scope, status, waited, received)
            log = logger.debug if scope["path"] in QUIET else logger.info
            caller, problem = scope["state"].get("caller"), scope["state"].get("problem")
            if scope["state"].get("running"):
                scope["app"].state.service.running.leave(caller.key)
            log("request", method=scope["method"], path=scope["path"], status=status, ms=round(1e3 * (time.perf_counter() - began), 1),
                client=scope["client"][0] if scope.get("client") else None, **({} if problem is None else {"problem": problem}),
                **({} if caller is None else {"project": caller.project, "key": caller.key}))


class Bodies:
    """Refuses bodies that say twice how long they are and, except those of uploads, bodies that are not JSON or larger than MAX_BYTES.

    A proxy before the service may believe the other header (RFC 9112, 6.3).
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Refuse a body before it is in memory; a body without a length, as soon as it is too large."""
        headers = dict(scope["headers"]) if scope["type"] == "http" else {}
        if b"transfer-encoding" in headers and b"content-length" in headers:
            await answer(Request(scope), "bad-request", "the request has both Content-Length and Transfer-Encoding: send one of them",
                         headers={"Connection": "close"})(scope, receive, send)
            return
        if scope["type"] != "http" or scope["path"].startswith(UPLOADS):
            await self._app(scope, receive, send)
            return
        length, kind = headers.get(b"content-length", b"0"), headers.get(b"content-type", b"").partition(b";")[0].strip().lower()
        if int(length) > MAX_BYTES:  # the server has refused a length that is not a number
            await answer(Request(scope), "too-large", TOO_LARGE)(scope, receive, send)
            return
        if (int(length) > 0 or b"transfer-encoding" in headers) and kind != b"application/json":
            await answer(Request(scope), "unsupported-media-type", "the body must be JSON: send Content-Type: application/json")(
                scope, receive, send)
            return
        received = 0

        async def limited() -> Message:
            nonlocal received
            message = await receive()
            received += len(message.get("body", b""))
            if received > MAX_BYTES:
                raise HTTPException(413, TOO_LARGE)
            return message

        await self._app(scope, limited, send)
