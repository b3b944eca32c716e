"""What a project is answered that has as much as it may, and that another project is not."""

from tests.service.server.api.conftest import SAMPLES
from tests.service.server.api.job_calls import accepted

TUS = {"Tus-Resumable": "1.0.0", "Upload-Metadata": "path YQ=="}


def test_captures(keyed):
    with keyed.client(keyed.key("quota-larch")) as larch, keyed.client(keyed.key("quota-willow")) as willow:
        made = [larch.post("/v1/captures", json={"name": "a"}).raise_for_status().json()["id"] for _ in range(2)]
        refused = larch.post("/v1/environments", json={"name": "a"})
        assert refused.status_code == 429 and int(refused.headers["Retry-After"]) > 0
        assert refused.json()["detail"].startswith("quota max_project_captures: the project quota-larch has 2 of 2 ")
        assert larch.delete(f"/v1/captures/{made[0]}").status_code == 204
        assert larch.post("/v1/environments", json={"name": "a"}).status_code == 201
        assert [willow.post("/v1/captures", json={"name": "a"}).status_code for _ in range(4)] == [201, 201, 201, 429]


def test_bytes(keyed):
    with keyed.client(keyed.key("oak")) as oak:
        place = f"/v1/captures/{oak.post('/v1/captures', json={'name': 'a'}).json()['id']}/files"
        assert oak.post(place, headers=TUS | {"Upload-Length": "60"}).status_code == 201
        refused = oak.post(place, headers=TUS | {"Upload-Length": "41", "Upload-Metadata": "path Yg=="})
        assert refused.status_code == 413 and refused.json()["detail"].startswith("quota max_project_bytes: the project oak has 60 of 100 ")
        assert oak.post(place, headers=TUS | {"Upload-Length": "40", "Upload-Metadata": "path Yg=="}).status_code == 201


def test_jobs(keyed, keyed_database):
    with keyed.client(keyed.key("elm")) as elm:
        request = {"kind": "solve", "capture": accepted(keyed_database, elm, "elm", SAMPLES / "owl")}
        first = elm.post("/v1/jobs", json=request)
        assert first.status_code == 202
        refused = elm.post("/v1/jobs", json=request)
        assert (refused.status_code, refused.json()["detail"].partition(":")[0]) == (429, "quota max_project_jobs")
        assert len(elm.get("/v1/jobs", params={"state": "queued"}).json()["jobs"]) == 1  # nothing is left behind
        elm.post(f"/v1/jobs/{first.json()['id']}/cancel").raise_for_status()
        assert elm.post("/v1/jobs", json=request).status_code == 202
        assert elm.post(f"/v1/jobs/{first.json()['id']}/resume").status_code == 429
