"""One server for the tests of the API, without keys and with one worker; each test makes its own captures and jobs."""

from pathlib import Path

import pytest

from tests.service.server import Server, serving

HOME = Path(__file__).resolve().parents[3]
SAMPLES = HOME / "samples"


@pytest.fixture(scope="session")
def server(tmp_path_factory: pytest.TempPathFactory):
    with serving(tmp_path_factory.mktemp("server"), "--anonymous", "--device", "cpu", roots=str(SAMPLES), requests_per_second="10000",
                 request_burst="10000", min_free_bytes="0") as running:
        yield running


@pytest.fixture(scope="session")
def client(server: Server):
    with server.client() as made:
        yield made


@pytest.fixture(scope="session")
def owl(server: Server, client):
    """The sample capture, registered and ready."""
    made = client.post("/v1/captures", json={"name": "owl", "folder": str(SAMPLES / "owl")}).raise_for_status().json()
    return server.wait(client, f"/v1/captures/{made['id']}", ("ready", "refused"))["id"]


@pytest.fixture(scope="session")
def sky(server: Server, client):
    """An environment, registered and ready."""
    made = client.post("/v1/environments", json={"name": "sky", "file": str(SAMPLES / "owl" / "environment.exr")}).raise_for_status().json()
    return server.wait(client, f"/v1/environments/{made['id']}", ("ready", "refused"))["id"]
