"""Bodies of requests: JSON, and not larger than JSON has to be. Those of uploads are taken in pieces elsewhere."""

from fastapi import Request
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.server.api.problems import answer

MAX_BYTES = 1 << 20
"""Of a request; light keys of a long film have some hundred kilobytes."""
UPLOADS = "/v1/uploads/"
TOO_LARGE = f"the body is larger than {MAX_BYTES} bytes"


class Bodies:
    """ASGI middleware."""

    def __init__(self, app: ASGIApp) -> None:
        """Args: app: inside."""
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Refuse a body before it is in memory; one without a length while it comes."""
        if scope["type"] != "http" or scope["path"].startswith(UPLOADS):
            await self._app(scope, receive, send)
            return
        headers = dict(scope["headers"])
        length = headers.get(b"content-length", b"0")
        if int(length) > MAX_BYTES:  # the server has refused what is no number
            await answer(Request(scope), "too-large", TOO_LARGE)(scope, receive, send)
            return
        if (int(length) > 0 or b"transfer-encoding" in headers) and not _is_json(headers.get(b"content-type", b"")):
            await answer(Request(scope), "unsupported-media-type", "the body must be JSON: send Content-Type: application/json")(
                scope, receive, send)
            return
        received = 0

        async def counted() -> Message:
            nonlocal received
            message = await receive()
            received += len(message.get("body", b""))
            if received > MAX_BYTES:
                raise HTTPException(413, TOO_LARGE)
            return message

        await self._app(scope, counted, send)


def _is_json(content_type: bytes) -> bool:
    return content_type.partition(b";")[0].strip().lower() == b"application/json"
