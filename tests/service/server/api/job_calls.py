"""Jobs through the API, as tests ask for them and wait for them."""

import json
from pathlib import Path

import httpx2

from service.requests.base.base import JobRequest
from service.requests.base.identifiers import CAPTURE, JOB, new_id
from service.server.database import intakes, jobs
from service.server.database.engine import Database
from service.server.storage import layout
from tests.service.server_process import Server
from tests.service.waiting import until

ENDED = ("succeeded", "failed", "cancelled")
NOBODY = new_id(JOB)


def submit(client: httpx2.Client, **request) -> dict:
    response = client.post("/v1/jobs", json=request)
    assert response.status_code == 202, response.text
    assert response.headers["Location"] == f"/v1/jobs/{response.json()['id']}"
    return response.json()


def finish(server: Server, client: httpx2.Client, job: dict, state: str = "succeeded") -> dict:
    ended = server.wait(client, f"/v1/jobs/{job['id']}", ENDED, timeout_s=300)
    assert ended["state"] == state, ended
    assert str(server.data) not in str(ended["error"])
    return ended


def finished(server: Server, client: httpx2.Client, **request) -> dict:
    """A job that succeeds."""
    return finish(server, client, submit(client, **request))


def succeeded(server: Server, request: JobRequest, project: str = "default") -> Path:
    """Record a job that nobody has done as one that has succeeded, and return the empty folder of its results, which has its name."""
    job = new_id(JOB)
    with server.database() as database:
        database.transact(lambda connection: jobs.insert(connection, project=project, request=request, finished=job))
    folder = server.data / layout.results(project, job)
    for path in (*reversed(folder.parents), folder):
        path.mkdir(mode=0o750, exist_ok=True)  # as the service makes them
    return folder


def error_of(server: Server, client: httpx2.Client, **request) -> str:
    """The error of a job that fails, which names no folder of the server."""
    return finish(server, client, submit(client, **request), "failed")["error"]


def result(client: httpx2.Client, job: dict, name: str) -> bytes:
    return client.get(f"/v1/jobs/{job['id']}/results/{name}").raise_for_status().content


def report_of(server: Server, client: httpx2.Client, job: dict, name: str = "report.json") -> dict:
    """What a job reports, which names no folder of the server."""
    text = result(client, job, name).decode()
    assert str(server.data) not in text and "/relit-linked-" not in text
    return json.loads(text)


def made_by(client: httpx2.Client, job: dict) -> set[str]:
    return {file["name"] for file in client.get(f"/v1/jobs/{job['id']}/results").raise_for_status().json()["results"]}


def refused(response: httpx2.Response, status: int, words: str) -> None:
    """A problem with these words and, where the same request may succeed later, the seconds until then."""
    assert response.status_code == status, response.text
    assert response.headers["Content-Type"] == "application/problem+json"
    assert words in response.json()["detail"], response.json()["detail"]
    assert (int(response.headers.get("Retry-After", 0)) >= 1) == (status in (423, 429, 503, 507))


def has_made(client: httpx2.Client, job: dict, count: int) -> None:
    """Wait until a job has made some frames."""
    until(lambda: len(made_by(client, job)) >= count, f"{count} frames")


def admitted(server: Server, client: httpx2.Client, folder: Path, state: str = "ready", *, kind: str = "captures") -> dict:
    """Register a folder, or the file of an environment, and return it as it is when it was checked."""
    where = {"captures": "folder", "environments": "file"}[kind]
    made = client.post(f"/v1/{kind}", json={"name": folder.name, where: str(folder)}).raise_for_status().json()
    found = server.wait(client, f"/v1/{kind}/{made['id']}", ("ready", "refused"))
    assert found["state"] == state, found
    return found


def checked(server: Server, folder: Path, **facts: object) -> str:
    """Put a registered capture there that is ready, though no worker has checked it."""
    with server.database() as database:
        made = database.transact(lambda connection: intakes.insert(
            connection, project="default", kind=CAPTURE, name=folder.name, folder=folder))
        intakes.accept(database, made, facts)
    return made


def accepted(database: Database, client: httpx2.Client, project: str, folder: Path) -> str:
    """Register a capture, and let it be ready, though there is no worker that would check it."""
    made = client.post("/v1/captures", json={"name": folder.name, "folder": str(folder)}).raise_for_status().json()["id"]
    intakes.accept(database, made, {"captures": 1})
    for job in jobs.latest(database, project, limit=500):
        if job["request"].get("intake") == made:
            database.transact(lambda connection, job=job["id"]: jobs.cancel(connection, job))
    return made
