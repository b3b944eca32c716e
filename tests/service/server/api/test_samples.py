"""The sample that comes with Relit, registered by one request, and the project that a key is told it belongs to."""

from collections.abc import Callable, Iterator

import pytest
from fastapi.testclient import TestClient

from service.errors import RequestError
from service.requests.base.identifiers import new_id
from service.requests.keys import Scope
from service.server.base.settings import Settings
from tests.service.server.api.asgi import app_of
from tests.service.server.api.job_calls import refused
from tests.service.server_process import new_key

KINDS = {"captures": "owl", "environments": "environment.exr"}
"""What each route registers."""


@pytest.fixture(scope="module")
def of(tmp_path_factory) -> Iterator[Callable[..., TestClient]]:
    """A client of a project, with a key of its own; no folder of the service may be registered by others."""
    settings = Settings(data=tmp_path_factory.mktemp("samples"), project_quotas="elm:max_project_captures=1", min_free_bytes=0)
    with app_of(settings) as app:
        def client(project: str, scope: Scope = Scope.WRITE) -> TestClient:
            headers = {"Authorization": f"Bearer {new_key(app.state.service.database, project, scope)}"}
            return TestClient(app, base_url="http://localhost", headers=headers)

        yield client


def test_a_key_is_told_its_project_and_its_scope(of):
    for project, scope in (("larch", Scope.READ), ("oak", Scope.WRITE)):
        assert of(project, scope).get("/v1/project").json() == {"name": project, "scope": scope}
    assert TestClient(of("larch").app, base_url="http://localhost").get("/v1/project").status_code == 401


@pytest.mark.parametrize("kind", KINDS)
def test_a_key_that_may_write_registers_the_sample_once_for_its_project(of, kind):
    larch, oak, token = of("larch"), of("oak"), {"Idempotency-Key": new_id("test")}
    assert of("larch", Scope.READ).post(f"/v1/samples/{kind}").status_code == 403
    made, again = (larch.post(f"/v1/samples/{kind}", headers=token) for _ in range(2))
    assert (made.status_code, made.json()["name"], made.json()["registered"]) == (201, KINDS[kind], True)
    assert made.json()["id"] == again.json()["id"]
    place = made.headers["Location"]
    assert larch.get(place).status_code == 200 and oak.get(place).status_code == 404
    assert [each["id"] for each in larch.get(f"/v1/{kind}").json()["items"]] == [made.json()["id"]]
    other = oak.post(f"/v1/samples/{kind}", headers=token)  # a token is one project's own
    assert other.status_code == 201 and other.json()["id"] != made.json()["id"]


def test_samples_count_towards_the_quota_of_a_project(of):
    elm = of("elm")
    assert [elm.post(f"/v1/samples/{kind}").status_code for kind in KINDS] == [201, 429]
    assert elm.get("/v1/environments").json()["items"] == []


def test_a_service_without_the_sample_says_so(of, monkeypatch):
    def absent():
        raise RequestError("the sample is not installed")

    monkeypatch.setattr("service.server.api.intakes.sample_folder", absent)
    for kind in KINDS:
        refused(of("larch").post(f"/v1/samples/{kind}"), 404, "without the sample capture")
