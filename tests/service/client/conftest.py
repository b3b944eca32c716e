"""One server with a worker for the tests of the client, reached with a key, and ways to break what lies between."""

import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import httpx2
import pytest

from service.client import Client
from tests.service.server_process import Server, serving

HOME = Path(__file__).resolve().parents[3]
OWL = HOME / "samples" / "owl"
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


@pytest.fixture(scope="session")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    with serving(tmp_path_factory.mktemp("server"), "--device", "cpu", sabotage="long", roots=str(OWL.parent),
                 requests_per_second="10000", request_burst="10000", min_free_bytes="0") as running:
        yield running


@pytest.fixture(scope="session")
def key(server: Server) -> str:
    return subprocess.run([sys.executable, "-m", "service.cli.main", "keys", "create", "--project", "owls", "--name", "tests", "--scope",
                           "admin", "--data", str(server.data)], check=True, capture_output=True, text=True, timeout=60).stdout.strip()


@pytest.fixture
def between() -> Between:
    return Between()


@pytest.fixture
def client(server: Server, key: str, between: Between) -> Iterator[Client]:
    with Client(server.url, key, patience_s=30, transport=between) as made:
        yield made


@pytest.fixture(scope="session")
def owl(server: Server, key: str) -> str:
    with Client(server.url, key) as client:
        return client.captures.register(str(OWL)).id


@pytest.fixture(scope="session")
def sky(server: Server, key: str) -> str:
    with Client(server.url, key) as client:
        return client.environments.register(str(SKY)).id
