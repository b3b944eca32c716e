"""Jobs through the API, as tests ask for them and wait for them."""

import time

import httpx2

from service.requests.base.identifiers import new_id
from tests.service.server_process import Server

ENDED = ("succeeded", "failed", "cancelled")
WAIT_S = 120.0
NOBODY = new_id("job")


def submit(client: httpx2.Client, **request) -> dict:
    response = client.post("/v1/jobs", json=request)
    assert response.status_code == 202, response.text
    assert response.headers["Location"] == f"/v1/jobs/{response.json()['id']}"
    return response.json()


def finish(server: Server, client: httpx2.Client, job: dict, state: str = "succeeded") -> dict:
    done = server.wait(client, f"/v1/jobs/{job['id']}", ENDED)
    assert done["state"] == state, done
    return done


def made_by(client: httpx2.Client, job: dict) -> set[str]:
    return {file["name"] for file in client.get(f"/v1/jobs/{job['id']}/results").raise_for_status().json()["results"]}


def refused(response: httpx2.Response, status: int, words: str) -> None:
    assert response.status_code == status, response.text
    assert response.headers["Content-Type"] == "application/problem+json"
    assert words in response.json()["detail"], response.json()["detail"]


def has_made(client: httpx2.Client, job: dict, count: int) -> None:
    """Wait until a job has made some frames."""
    deadline = time.monotonic() + WAIT_S
    while len(made_by(client, job)) < count:
        assert time.monotonic() < deadline
        time.sleep(0.05)
