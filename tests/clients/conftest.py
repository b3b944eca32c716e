"""Programs that open assets."""

from collections.abc import Iterator

import pytest

from benchmarks.clients.render import Client, Programs
from tests.clients.programs import require


@pytest.fixture(params=list(Client))
def client(request: pytest.FixtureRequest) -> Client:
    """Each program in turn."""
    return require(request.param)


@pytest.fixture(scope="session")
def programs() -> Iterator[Programs]:
    """All of them, each started once."""
    with Programs() as made:
        yield made
