"""What a project is answered that has as much as it may, and that another project is not."""

import pytest

from service.requests.keys import NewKey, Scope
from service.server.base.settings import Settings
from service.server.database import intakes, jobs, keys
from service.server.database.engine import connect
from tests.service.server_process import serving

TUS = {"Tus-Resumable": "1.0.0", "Upload-Metadata": "path YQ=="}


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    with serving(tmp_path_factory.mktemp("quotas"), "--device", "none", min_free_bytes="0", max_project_captures="2", max_project_jobs="1",
                 max_project_bytes="100", project_quotas="willow:max_project_captures=3") as server:
        database = connect(Settings(data=server.data).sqlalchemy_url)
        yield lambda project: server.client(keys.create(database, NewKey(project=project, name="x", scope=Scope.WRITE))), database
        database.close()


@pytest.mark.long
def test_captures(site):
    client, _ = site
    with client("larch") as larch, client("willow") as willow:
        made = [larch.post("/v1/captures", json={"name": "a"}).raise_for_status().json()["id"] for _ in range(2)]
        refused = larch.post("/v1/environments", json={"name": "a"})
        assert refused.status_code == 429 and int(refused.headers["Retry-After"]) > 0
        assert refused.json()["detail"].startswith("quota max_project_captures: the project larch has 2 of 2 ")
        assert larch.delete(f"/v1/captures/{made[0]}").status_code == 204
        assert larch.post("/v1/environments", json={"name": "a"}).status_code == 201
        assert [willow.post("/v1/captures", json={"name": "a"}).status_code for _ in range(4)] == [201, 201, 201, 429]


def test_bytes(site):
    client, _ = site
    with client("oak") as oak:
        place = f"/v1/captures/{oak.post('/v1/captures', json={'name': 'a'}).json()['id']}/files"
        assert oak.post(place, headers=TUS | {"Upload-Length": "60"}).status_code == 201
        refused = oak.post(place, headers=TUS | {"Upload-Length": "41", "Upload-Metadata": "path Yg=="})
        assert refused.status_code == 413 and refused.json()["detail"].startswith("quota max_project_bytes: the project oak has 60 of 100 ")
        assert oak.post(place, headers=TUS | {"Upload-Length": "40", "Upload-Metadata": "path Yg=="}).status_code == 201


def test_jobs(site):
    client, database = site
    with client("elm") as elm:
        capture = elm.post("/v1/captures", json={"name": "a"}).json()["id"]
        database.transact(lambda connection: intakes.begin_check(connection, capture))
        intakes.accept(database, capture, {"captures": 1})
        first = elm.post("/v1/jobs", json={"kind": "solve", "capture": capture})
        assert first.status_code == 202
        refused = elm.post("/v1/jobs", json={"kind": "solve", "capture": capture})
        assert (refused.status_code, refused.json()["detail"].partition(":")[0]) == (429, "quota max_project_jobs")
        assert len(jobs.latest(database, "elm", limit=9)) == 1  # nothing is left behind
        elm.post(f"/v1/jobs/{first.json()['id']}/cancel").raise_for_status()
        assert elm.post("/v1/jobs", json={"kind": "solve", "capture": capture}).status_code == 202
        assert elm.post(f"/v1/jobs/{first.json()['id']}/resume").status_code == 429
