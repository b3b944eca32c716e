"""A receiver of hooks on this machine, which answers as a test wants; its signatures are verified without relit's code."""

import base64
import hashlib
import hmac
import json
import ssl
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from tests.service.answering import Asked, answering

TOLERANCE_S = 300


class Received(Asked):
    """A request."""

    @property
    def id(self) -> str:
        return self.headers["webhook-id"]

    @property
    def event(self) -> dict[str, Any]:
        return json.loads(self.body)


class Receiver:
    """A receiver and what came to it."""

    def __init__(self) -> None:
        self.received: list[Received] = []
        self.status: int | Callable[[Received], int] = 204
        self.held: threading.Event | None = None
        """If there is one, requests get no answer until it is set."""
        self.url = ""

    def ids(self) -> list[str]:
        return [each.id for each in self.received]


def verified(secret: str, received: Received, now: float | None = None) -> bool:
    """Verify a signature by the words of Standard Webhooks 1.0: HMAC-SHA256 of `id.timestamp.body` with the bytes behind whsec_."""
    headers = received.headers
    if abs((time.time() if now is None else now) - int(headers["webhook-timestamp"])) > TOLERANCE_S:
        return False
    signed = f"{headers['webhook-id']}.{headers['webhook-timestamp']}.".encode() + received.body
    wanted = base64.b64encode(hmac.new(base64.b64decode(secret[len("whsec_"):], validate=True), signed, hashlib.sha256).digest()).decode()
    return any(hmac.compare_digest(f"v1,{wanted}", given) for given in headers["webhook-signature"].split(" "))


@contextmanager
def receiving(host: str = "127.0.0.1", port: int = 0, tls: ssl.SSLContext | None = None) -> Iterator[Receiver]:
    """Run a receiver."""
    receiver = Receiver()

    def answer(asked: Asked) -> tuple[int, bytes]:
        received = Received(*asked)
        receiver.received.append(received)
        if receiver.held is not None:
            receiver.held.wait(60)
        return receiver.status if isinstance(receiver.status, int) else receiver.status(received), b""

    with answering(answer, host=host, port=port, tls=tls, Location="http://127.0.0.1:1/elsewhere") as url:
        receiver.url = f"{url}/relit?studio=larch"
        try:
            yield receiver
        finally:
            if receiver.held is not None:
                receiver.held.set()
