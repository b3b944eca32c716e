"""The server of the tests of the API, reached with a key by the tests of the client, and ways to break what lies between."""

from collections.abc import Callable, Iterator
from typing import NoReturn

import httpx2
import pytest

from service.client import Client
from tests.service.conftest import SAMPLES
from tests.service.server_process import Server

HOME = SAMPLES.parent
OWL = SAMPLES / "owl"
SKY = OWL / "environment.exr"


class Between(httpx2.BaseTransport):
    """The network, until a test says otherwise: every request is noted, and may be broken."""

    def __init__(self) -> None:
        self.inner = httpx2.HTTPTransport()
        self.requests: list[httpx2.Request] = []
        self.breaks: Callable[[httpx2.Request, Callable[[], httpx2.Response]], httpx2.Response] = lambda request, send: send()

    def handle_request(self, request: httpx2.Request) -> httpx2.Response:
        self.requests.append(request)
        return self.breaks(request, lambda: self.inner.handle_request(request))

    def close(self) -> None:
        self.inner.close()

    def sent(self, method: str) -> list[str]:
        return [request.url.path for request in self.requests if request.method == method]


class Cut(httpx2.SyncByteStream):
    """A body that breaks off after so many bytes."""

    def __init__(self, inner: httpx2.SyncByteStream, count: int, error: type[httpx2.TransportError]) -> None:
        self.inner, self.left, self.error = inner, count, error

    def __iter__(self) -> Iterator[bytes]:
        for piece in self.inner:
            yield piece[: self.left]
            self.left -= len(piece)
            if self.left <= 0:
                raise self.error("cut by the test")

    def close(self) -> None:
        self.inner.close()


def lose(answer: httpx2.Response) -> NoReturn:
    """Let an answer be lost on its way."""
    answer.read()
    answer.close()
    raise httpx2.ReadError("the test lost the answer")


@pytest.fixture(scope="session")
def key(server: Server) -> str:
    return server.key("owls")


@pytest.fixture
def between() -> Between:
    return Between()


@pytest.fixture
def client(server: Server, key: str, between: Between) -> Iterator[Client]:
    with Client(server.url, key, patience_s=30, transport=between) as made:
        yield made


@pytest.fixture(scope="session")
def dome(server: Server, key: str) -> str:
    with Client(server.url, key) as client:
        return client.captures.register(str(OWL.parent / "lambert")).id


@pytest.fixture(scope="session")
def sky(server: Server, key: str) -> str:
    with Client(server.url, key) as client:
        return client.environments.register(str(SKY)).id
