"""The link to the service: requests that are sent again where that is safe, and answers made objects or errors."""

import random
import secrets
import time
from collections.abc import Callable
from email.utils import parsedate_to_datetime
from typing import Any
from urllib.parse import quote

import httpx2

from service.client.errors import ClientError, Unreachable, refusal

FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.2, 10.0
LATER = (429, 503)
"""Statuses with which nothing was done, and may be soon."""
PROXY = (502, 504)
"""Of a proxy that got no answer: it may have been done."""
NOT_SENT = (httpx2.ConnectError, httpx2.ConnectTimeout, httpx2.PoolTimeout)


class Patience:
    """How long to go on trying, and the pauses between."""

    def __init__(self, seconds: float) -> None:
        """Args: seconds: after which the error of the last try is raised."""
        self._seconds = seconds
        self.refresh()

    def refresh(self) -> None:
        """Something went well: be as patient as at the beginning."""
        self._pause, self._deadline = FIRST_PAUSE_S, time.monotonic() + self._seconds

    def wait(self, asked_s: float | None = None) -> bool:
        """Sleep before the next try.

        Args:
            asked_s: how long the service asked for.

        Returns:
            Whether to try again; false, at once, where the pause is longer than patience lasts.
        """
        pause = self._pause * random.uniform(0.5, 1.0) if asked_s is None else asked_s  # so that clients do not come back all at once
        if time.monotonic() + pause > self._deadline:
            return False
        time.sleep(pause)
        self._pause = min(2 * self._pause, LONGEST_PAUSE_S)
        return True


class Link:
    """Requests to one service with one key; may be used from several threads."""

    def __init__(self, server: str, key: str | None, *, patience_s: float, timeout_s: float,
                 transport: httpx2.BaseTransport | None = None) -> None:
        """Args: as of `Client`."""
        self.server, self._patience_s = server.rstrip("/").removesuffix("/v1"), patience_s
        if key is not None and not (key.isascii() and key.isprintable()):
            raise ClientError("the key has characters that no key has")
        try:
            url = httpx2.URL(self.server)
        except httpx2.InvalidURL:
            url = httpx2.URL()
        if url.scheme not in ("http", "https") or not url.host:
            raise Unreachable(f"{server}: is no URL of a service: give one such as https://relit.example")
        self.http = httpx2.Client(base_url=url, headers={} if key is None else {"Authorization": f"Bearer {key}"}, timeout=timeout_s,
                                  transport=transport)

    @staticmethod
    def token() -> str:
        """A new Idempotency-Key."""
        return secrets.token_hex(16)

    @staticmethod
    def path(*parts: str) -> str:
        """A path of the API: the first part as it is, whatever the others hold as one part each."""
        return "/".join([parts[0], *(quote(part, safe="") for part in parts[1:])])

    def patience(self) -> Patience:
        """A new one."""
        return Patience(self._patience_s)

    def send(self, method: str, path: str, *, repeatable: bool = True, **options: Any) -> httpx2.Response:
        """Send a request, again where that is safe, until it is answered.

        Args:
            method, path: of the request.
            repeatable: done twice it does what done once does; otherwise it is sent again only where it was not done.
            options: of httpx2: json, params, headers …

        Raises:
            Refused: the service says no.
            Unreachable: it does not answer.
        """
        return self._retry(lambda: self.once(method, path, **options), repeatable=repeatable)

    def once(self, method: str, path: str, **options: Any) -> httpx2.Response:
        """Send a request once; an answer that is an error is returned like any other."""
        return self.http.request(method, path, **options)

    def _retry(self, attempt: Callable[[], httpx2.Response], *, repeatable: bool) -> httpx2.Response:
        patience = self.patience()
        while True:
            try:
                answer = attempt()
            except httpx2.TransportError as error:
                again = repeatable or isinstance(error, NOT_SENT)
                if not again or not patience.wait():
                    raise self.unreachable(error, unknown=not again) from error
                continue
            if answer.is_success:
                return answer
            if (answer.status_code in LATER or (repeatable and answer.status_code in PROXY)) and patience.wait(retry_after(answer)):
                continue
            raise refusal(answer.status_code, answer.headers.get("content-type", ""), answer.content)

    def unreachable(self, error: Exception, *, unknown: bool = False) -> Unreachable:
        """The error of a service that does not answer; unknown: whether it did what it was asked."""
        reason = " ".join(str(error).split()) or type(error).__name__
        return Unreachable(f"{self.server} does not answer{', and may have done what was asked' if unknown else ''}: {reason}")


def retry_after(answer: httpx2.Response) -> float | None:
    """Seconds that an answer asks to wait; None: it does not say."""
    given = answer.headers.get("retry-after", "")
    if given.isdecimal():
        return float(given)
    try:
        return max(0.0, parsedate_to_datetime(given).timestamp() - time.time())
    except ValueError:
        return None
