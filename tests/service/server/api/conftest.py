"""What the tests of the API have on their server, which has no keys and one worker; each test makes its own captures and jobs."""

import re
from pathlib import Path

import pytest

from tests.service.conftest import SAMPLES
from tests.service.server.api.job_calls import admitted, finish, submit
from tests.service.server.api.tus import Tus
from tests.service.server_process import Server, serving

PEAK_BYTES = 1 << 30
"""Of a worker: its libraries take a fifth, and a manifest of MAX_MANIFEST_BYTES up to 40 times its size."""


@pytest.fixture(scope="session")
def registered(server: Server):
    """A folder of the server whose captures and environments may be registered, beside the samples."""
    folder = server.data.parent / "registered"
    folder.mkdir()
    return folder


@pytest.fixture(scope="session")
def client(server: Server):
    with server.client() as made:
        yield made


@pytest.fixture(scope="session")
def owl(server: Server, client):
    """The sample capture, registered and ready."""
    return admitted(server, client, SAMPLES / "owl")["id"]


@pytest.fixture(scope="session")
def dome(server: Server, client):
    """A small capture whose light directions and shape are known."""
    return admitted(server, client, SAMPLES / "lambert")["id"]


@pytest.fixture(scope="session")
def rig(server: Server, client):
    """A capture of projected patterns."""
    return admitted(server, client, SAMPLES / "rig")["id"]


@pytest.fixture(scope="session")
def sky(server: Server, client):
    """An environment, registered and ready."""
    return admitted(server, client, SAMPLES / "owl" / "environment.exr", kind="environments")["id"]


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


@pytest.fixture(scope="session")
def keyed(tmp_path_factory: pytest.TempPathFactory):
    """A server that asks for keys and has no worker, so that jobs stay as they were handed in."""
    folder = tmp_path_factory.mktemp("keyed")
    (folder / "of-willow" / "owl").mkdir(parents=True)
    quotas = {"quota-larch": "max_project_captures=2", "quota-willow": "max_project_captures=3", "oak": "max_project_bytes=100",
              "beech": "max_project_bytes=100", "elm": "max_project_jobs=1"}
    with serving(folder, "--device", "none", host="0.0.0.0", roots=str(SAMPLES), project_roots=f"willow={folder / 'of-willow'}",
                 project_quotas=",".join(f"{project}:{quota}" for project, quota in quotas.items())) as running:
        yield running


@pytest.fixture(scope="session")
def keyed_database(keyed: Server):
    with keyed.database() as made:
        yield made


@pytest.fixture(scope="module")
def worker_lives(server: Server, client, dome):
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
