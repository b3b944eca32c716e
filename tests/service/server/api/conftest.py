"""One server for the tests of the API, without keys and with one worker; each test makes its own captures and jobs."""

import os
import re
from pathlib import Path

import pytest

from tests.service.server.api.job_calls import finish, submit
from tests.service.server.api.tus import Tus
from tests.service.server_process import Server, serving

HOME = Path(__file__).resolve().parents[4]
SAMPLES = HOME / "samples"
PEAK_BYTES = 1 << 30
"""Of a worker: its libraries take a fifth, and a manifest of MAX_MANIFEST_BYTES up to 40 times its size."""


@pytest.fixture(scope="session")
def server(tmp_path_factory: pytest.TempPathFactory):
    folder = tmp_path_factory.mktemp("server")
    with serving(folder, "--anonymous", "--device", "cpu", sabotage="long",
                 roots=os.pathsep.join([str(SAMPLES), str(folder / "registered")]), requests_per_second="10000", request_burst="10000",
                 min_free_bytes="0") as running:
        yield running


@pytest.fixture(scope="session")
def registered(server: Server):
    """A folder of the server whose captures and environments may be registered, beside the samples."""
    folder = server.data.parent / "registered"
    folder.mkdir()
    return folder


def register(server: Server, client, name: str) -> str:
    """A capture of the samples, registered and ready."""
    made = client.post("/v1/captures", json={"name": name, "folder": str(SAMPLES / name)}).raise_for_status().json()
    found = server.wait(client, f"/v1/captures/{made['id']}", ("ready", "refused"))
    assert found["state"] == "ready", found["problem"]
    return found["id"]


@pytest.fixture(scope="session")
def client(server: Server):
    with server.client() as made:
        yield made


@pytest.fixture(scope="session")
def owl(server: Server, client):
    """The sample capture, registered and ready."""
    return register(server, client, "owl")


@pytest.fixture(scope="session")
def dome(server: Server, client):
    """A small capture whose light directions and shape are known."""
    return register(server, client, "lambert")


@pytest.fixture(scope="session")
def rig(server: Server, client):
    """A capture of projected patterns."""
    return register(server, client, "rig")


@pytest.fixture(scope="session")
def sky(server: Server, client):
    """An environment, registered and ready."""
    made = client.post("/v1/environments", json={"name": "sky", "file": str(SAMPLES / "owl" / "environment.exr")}).raise_for_status().json()
    return server.wait(client, f"/v1/environments/{made['id']}", ("ready", "refused"))["id"]


@pytest.fixture(scope="session")
def solved(server: Server, client, dome) -> str:
    """A job that has solved the small capture."""
    job = submit(client, kind="solve", capture=dome, options={"method": "lambert"})
    return finish(server, client, job)["id"]


@pytest.fixture(scope="session")
def long(dome, sky) -> dict:
    """A request for frames that take longer than any test waits."""
    return {"kind": "relight", "capture": dome, "environment": sky, "options": {"frames": "1-300", "spin_degrees": 360}}


@pytest.fixture(scope="session")
def tus(server: Server) -> Tus:
    return Tus(server.url)


@pytest.fixture
def capture(client) -> str:
    return f"/v1/captures/{client.post('/v1/captures', json={'name': 'uploads'}).raise_for_status().json()['id']}"


@pytest.fixture(scope="module")
def worker_lives(server: Server, client, owl):
    """Nothing that the tests of a module send costs the worker its life, or more memory than it may have."""
    before = workers(server)
    assert before
    yield
    assert client.get("/v1/captures").status_code == 200
    assert workers(server) == before
    for pid in before:
        peak = re.search(r"VmHWM:\s+(\d+) kB", Path(f"/proc/{pid}/status").read_text())
        assert peak is not None and 1024 * int(peak[1]) < PEAK_BYTES
    assert '"level": "error"' not in server.log.read_text()


def workers(server: Server) -> list[int]:
    """Processes of the server's workers, from their names."""
    names = [line["worker"] for line in server.lines() if line["event"] == "worker ready"]
    return [pid for pid in (int(name.split("-")[-2]) for name in names) if Path(f"/proc/{pid}").exists()]
