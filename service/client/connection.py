"""Requests to the service: repeated where that is safe, with errors raised as `ClientError`."""

import random
import time
from collections.abc import Callable, Iterator
from email.utils import parsedate_to_datetime
from typing import Any, TypeVar
from urllib.parse import quote

import httpx2
from pydantic import BaseModel

from service.client.errors import ClientError, Unreachable, refusal
from service.requests.answers import IntakePage, JobPage, ResultPage

FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.2, 10.0
LATER = (429, 503)
"""Statuses of a request that was not carried out, and may be if it is sent again later."""
PROXY = (502, 504)
"""Statuses of a proxy that got no answer from the service: the request may have been carried out."""
Answer = TypeVar("Answer", bound=BaseModel)
Page = TypeVar("Page", IntakePage, JobPage, ResultPage)
NOT_SENT = (httpx2.ConnectError, httpx2.ConnectTimeout, httpx2.PoolTimeout)


class Backoff:
    """Exponential backoff with jitter: pauses between tries that grow, until a limit of seconds since creation or the last `reset`."""

    def __init__(self, limit_s: float) -> None:
        self._limit_s = limit_s
        self.reset()

    def reset(self) -> None:
        """Begin again with the first pause and the whole time limit, because there was progress."""
        self._pause, self._deadline = FIRST_PAUSE_S, time.monotonic() + self._limit_s

    def wait(self, asked_s: float | None = None) -> bool:
        """Sleep before the next try, as long as the service asked for or its own pause; return False at once if that exceeds the limit."""
        pause = self._pause * random.uniform(0.5, 1.0) if asked_s is None else asked_s  # so that clients do not come back all at once
        if time.monotonic() + pause > self._deadline:
            return False
        time.sleep(pause)
        self._pause = min(2 * self._pause, LONGEST_PAUSE_S)
        return True


class Connection:
    """Sends requests to one service under one key; several threads may use one connection."""

    def __init__(self, server: str, key: str | None, *, patience_s: float, timeout_s: float,
                 transport: httpx2.BaseTransport | None = None, on_silence: Callable[[str], None] | None = None) -> None:
        self.server, self._patience_s, self._on_silence = server.rstrip("/").removesuffix("/v1"), patience_s, on_silence
        if key is not None and not (key.isascii() and key.isprintable()):
            raise ClientError("the key has characters that no key has")
        try:
            url = httpx2.URL(self.server)
        except httpx2.InvalidURL:
            url = httpx2.URL()
        if url.scheme not in ("http", "https") or not url.host or not 0 < (url.port or 80) < 65_536:
            raise Unreachable(f"{server}: is no URL of a service: give one such as https://relit.example")
        self.http = httpx2.Client(base_url=url, headers={} if key is None else {"Authorization": f"Bearer {key}"}, timeout=timeout_s,
                                  transport=transport)

    @staticmethod
    def path(base: str, *parts: str) -> str:
        """Return a path of the API: `base` as given, then each part escaped, so that it stays one segment."""
        return "/".join([base, *(quote(part, safe="") for part in parts)])

    def backoff(self) -> Backoff:
        """Return a new backoff with the time limit `patience_s`."""
        return Backoff(self._patience_s)

    def send(self, method: str, path: str, *, repeatable: bool = True, **options: Any) -> httpx2.Response:
        """Send a request, and repeat it where that is safe, until the service answers.

        Args:
            method, path, options: of the request, as httpx2 takes them.
            repeatable: whether carrying the request out twice has the same effect as once; if not, it is repeated only where it is
                certain that it was not carried out.
        """
        backoff = self.backoff()
        while True:
            try:
                answer = self.http.request(method, path, **options)
            except httpx2.TransportError as error:
                again = repeatable or isinstance(error, NOT_SENT)
                if again and self._on_silence is not None:
                    self._on_silence(f"{self.unreachable(error)}; asked again for {self._patience_s:.0f} s")
                    self._on_silence = None
                if not again or not backoff.wait():
                    raise self.unreachable(error, unknown=not again) from error
                continue
            if answer.is_success:
                return answer
            if (answer.status_code in LATER or (repeatable and answer.status_code in PROXY)) and backoff.wait(retry_after(answer)):
                continue
            raise refusal(answer)

    def ask(self, kind: type[Answer], method: str, path: str, **options: Any) -> Answer:
        """Send a request as `send` does, and return its answer as the model `kind`."""
        return kind.model_validate_json(self.send(method, path, **options).content)

    def pages(self, kind: type[Page], path: str, cursor: str, **params: Any) -> Iterator[Page]:
        """Yield the pages of a listing, each a `kind` whose `next` is the value of the parameter `cursor` for the page after it."""
        page = self.ask(kind, "GET", path, params=params)
        yield page
        while (place := page.next) is not None:
            page = self.ask(kind, "GET", path, params={**params, cursor: place})
            yield page

    def unreachable(self, error: Exception, *, unknown: bool = False) -> Unreachable:
        """Return the error for a service that does not answer; `unknown`: the request may have been carried out all the same."""
        reason = " ".join(str(error).split()) or type(error).__name__
        return Unreachable(f"{self.server} does not answer{', and may have done what was asked' if unknown else ''}: {reason}")


def retry_after(answer: httpx2.Response) -> float | None:
    """Return the seconds that the header Retry-After asks to wait, or None if it is missing or malformed."""
    given = answer.headers.get("retry-after", "")
    if given.isdecimal():
        return float(given)
    try:
        return max(0.0, parsedate_to_datetime(given).timestamp() - time.time())
    except ValueError:
        return None
