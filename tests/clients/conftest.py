"""Programs that open assets."""

import pytest

from benchmarks.clients.render import Client
from tests.clients.programs import require


@pytest.fixture(params=list(Client))
def client(request: pytest.FixtureRequest) -> Client:
    """Each program in turn."""
    return require(request.param)
