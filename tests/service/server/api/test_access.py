"""Who may do what: keys, their scopes, projects that see nothing of each other, and a service that asks for no key."""

import hashlib
import json
import re
import time
from typing import NamedTuple

import httpx2
import pytest

from service.requests.base.identifiers import ANNOTATION, CAPTURE, ENVIRONMENT, HOOK, JOB, UPLOAD, new_id
from service.requests.keys import Scope
from service.server.database import tables, workers
from service.server.database.engine import Database
from tests.service.server.api.asgi import openapi
from tests.service.server.api.conftest import SAMPLES
from tests.service.server.api.job_calls import accepted, refused
from tests.service.server_process import Server, new_key, revoke

OPEN = {("get", "/healthz"), ("get", "/readyz")}
"""Need no key; nor does OPTIONS, which says what tus can do here."""
STREAMS = {"/v1/events", "/v1/jobs/{job}/events"}
CHANGES = {"post", "put", "patch", "delete"}
TUS = {"Tus-Resumable": "1.0.0"}
SECRET_NAME = "nightingale"
"""Of what the first project has: the second must never read it."""


class Site(NamedTuple):
    """A server with keys, and what its first project has: a capture, an environment, an upload and a job with a result."""

    server: Server
    database: Database
    ours: dict[str, str]

    def client(self, project: str, scope: Scope = Scope.ADMIN) -> httpx2.Client:
        return self.server.client(self.server.key(project, scope))


@pytest.fixture(scope="module")
def site(keyed, keyed_database):
    made = Site(keyed, keyed_database, {})
    with made.client("larch") as client:
        capture = accepted(keyed_database, client, "larch", SAMPLES / "owl")
        sky = client.post("/v1/environments", json={"name": SECRET_NAME}).json()["id"]
        files = client.post(f"/v1/environments/{sky}/files", headers={
            **TUS, "Upload-Length": "5", "Upload-Metadata": "path c2t5LmV4cg=="}).raise_for_status()
        job = client.post("/v1/jobs", json={"kind": "solve", "capture": capture, "name": SECRET_NAME}).raise_for_status().json()["id"]
    results = keyed.data / "projects/larch/jobs" / job
    results.mkdir(parents=True)
    (results / "maps.exr").write_bytes(b"maps")
    with made.client("larch") as client:
        hook = client.post("/v1/hooks", json={"url": f"https://chat.example/{SECRET_NAME}"}).raise_for_status().json()["id"]
        note = client.post(f"/v1/captures/{capture}/annotations", json={"body": {"type": "TextualBody", "value": SECRET_NAME}, "target": {
            "selector": {"type": "PointSelector", "x": 1, "y": 1}}}).raise_for_status().json()["id"]
    made.ours.update(capture=capture, environment=sky, upload=files.headers["Location"].rpartition("/")[2], job=job, name="maps.exr",
                     hook=hook, annotation=note.rpartition("/")[2], worker="nobody-cpu-1")
    return made


def operations() -> list[tuple[str, str]]:
    """Method and path of everything that the OpenAPI document names."""
    found = [(method, path) for path, item in openapi()["paths"].items() for method in item if method not in ("parameters", "options")]
    assert len(found) > 25
    return found


def ask(client: httpx2.Client, method: str, path: str, names: dict[str, str]) -> httpx2.Response:
    """One request; of a stream only its beginning."""
    url = re.sub(r"{(\w+)}", lambda found: names[found[1]], path)
    body = {"json": {}} if method in ("post", "patch") and "uploads" not in path and "files" not in path else {}
    headers = {**TUS, "Upload-Offset": "0", "Upload-Length": "5", "Upload-Metadata": "path c2t5LmV4cg=="} if (
        "upload" in path or "files" in path) else {}
    if method == "patch" and "uploads" in path:
        headers |= {"Content-Type": "application/offset+octet-stream"}
    with client.stream(method.upper(), url, headers=headers, **body) as response:
        if path not in STREAMS or response.status_code != 200:
            response.read()
        return response


def of_admins(path: str) -> bool:
    """The URL of a hook is seen by those who may set it: whoever knows that of a chat can write there."""
    return path in ("/metrics", "/v1/audit") or path.startswith(("/v1/machines", "/v1/hooks"))


@pytest.mark.long
def test_every_route_but_those_of_health_asks_for_a_key(site):
    with site.server.client() as client:
        for method, path in operations():
            response = ask(client, method, path, site.ours)
            if (method, path) in OPEN:
                assert response.status_code in (200, 503)
                continue
            assert response.status_code == 401, (method, path, response.text)
            assert response.headers["WWW-Authenticate"] == "Bearer"
            if method != "head":
                assert response.json()["type"] == "urn:relit:problem:unauthenticated"


def test_what_is_no_key_of_ours_is_refused_and_told_why_if_its_secret_is_right(site):
    good, other, revoked = (site.server.key("larch", Scope.READ) for _ in range(3))
    expired = new_key(site.database, scope=Scope.READ, expires_days=1e-9)
    identifier, _, secret = good.partition(".")
    with site.server.client() as client:
        for key in (good, revoked):
            assert client.get("/v1/jobs", headers={"Authorization": f"Bearer {key}"}).status_code == 200
        assert revoke(site.database, revoked) and not revoke(site.database, revoked)
        unknown = ("x", identifier, f"{identifier}.", f"{identifier}.{secret[:-1]}", f"{identifier}.{secret}x",
                   f"{other.partition('.')[0]}.{secret}", f".{secret}", hashlib.sha256(secret.encode()).hexdigest(), "\u00e9" * 3,
                   f"{revoked}x", f"{expired}x")
        for given, words in (*((each, "this service does not know the key") for each in unknown), (revoked, "the key was revoked on"),
                             (expired, "the key expired on")):
            response = client.get("/v1/jobs", headers={"Authorization": f"Bearer {given}".encode()})
            assert response.status_code == 401 and response.json()["detail"].startswith(words), given
        assert client.get("/v1/jobs", headers={"Authorization": f"Basic {good}"}).status_code == 401
        assert client.get("/v1/jobs", params={"key": good}).status_code in (401, 422)


def test_machines_and_the_audit_log_are_for_admins_and_show_nothing_of_other_projects(site):
    with site.client("larch") as admin, site.client("unseen") as other, site.client("larch", Scope.WRITE) as writer:
        assert writer.get("/v1/machines").status_code == writer.get("/v1/audit").status_code == 403
        machines = admin.get("/v1/machines").raise_for_status().json()
        assert machines["disk"]["total"] > machines["disk"]["free"] > 0 and machines["jobs"]["queued"] >= 1
        assert machines["queued_since"] is not None and machines["workers"] == []
        now = time.time()
        site.database.execute(tables.workers.insert().values(id="worker", host="here", pid=1, device="cpu", started_at=now, seen_at=now,
                                                             state="ready"))
        worker, = admin.get("/v1/machines").json()["workers"]
        assert (worker["device"], worker["state"], worker["busy"], worker["job"]) == ("cpu", "ready", False, None)
        assert writer.post("/v1/machines/worker/kill").status_code == 403
        assert admin.post("/v1/machines/nobody/kill").status_code == admin.post("/v1/machines/nobody/drain").status_code == 404
        assert worker["asked"] is None and workers.seen_lately(site.database)[0]["asked"] is None
        assert admin.post("/v1/machines/worker/drain").json()["asked"] == "drain" == workers.seen_lately(site.database)[0]["asked"]
        last = admin.get("/v1/audit", params={"limit": 1}).json()["entries"][0]
        assert (last["action"], last["object"]) == ("worker.drain", "worker")
        site.database.execute(tables.workers.delete())
        page = admin.get("/v1/audit", params={"limit": 2}).raise_for_status().json()
        assert len(page["entries"]) == 2 and page["next"] == page["entries"][1]["id"]
        older = admin.get("/v1/audit", params={"limit": 500, "before": page["next"]}).json()
        numbers = [entry["id"] for entry in page["entries"] + older["entries"]]
        assert numbers == sorted(set(numbers), reverse=True) and older["next"] is None
        assert {"intake.create", "job.submit", "hook.create"} <= {entry["action"] for entry in page["entries"] + older["entries"]}
        assert other.get("/v1/audit").json() == {"entries": [], "next": None}


def test_only_a_hash_of_a_key_is_kept_and_the_numbers_name_no_project(site):
    identifier, _, secret = site.server.key("larch", Scope.READ).partition(".")
    kept = b"".join(path.read_bytes() for path in site.server.data.glob("relit.sqlite*"))
    assert identifier.encode() in kept and hashlib.sha256(secret.encode()).hexdigest().encode() in kept
    assert secret.encode() not in kept
    assert secret not in site.server.log.read_text()
    with site.client("larch") as client:
        client.get(f"/v1/jobs/{site.ours['job']}")
        client.get(f"/v1/{SECRET_NAME}")
        text = client.get("/metrics").text
    assert 'route="/v1/jobs/{job}"' in text
    for word in ("larch", "willow", SECRET_NAME, *(value for name, value in site.ours.items() if name != "name"), "key_"):
        assert word not in text


def test_a_key_that_reads_changes_nothing(site):
    with site.client("larch", Scope.READ) as client:
        for method, path in operations():
            response = ask(client, method, path, site.ours)
            if method in CHANGES or of_admins(path):
                refused(response, 403, "has the scope read, this needs")
            else:
                assert response.status_code not in (401, 403), (method, path)
        assert client.get(f"/v1/jobs/{site.ours['job']}").json()["state"] == "queued"


def test_a_key_that_writes_registers_no_folders_and_reads_no_numbers(site):
    with site.client("larch", Scope.WRITE) as client:
        for method, path in operations():
            if path.endswith("}") and method == "delete":
                assert not of_admins(path) or ask(client, method, path, site.ours).status_code == 403
                continue  # it may delete the others, which are still needed
            assert (ask(client, method, path, site.ours).status_code == 403) == of_admins(path), (method, path)
        owl = SAMPLES / "owl"
        for kind, what in (("captures", {"folder": str(owl)}), ("environments", {"file": str(owl / "environment.exr")})):
            refused(client.post(f"/v1/{kind}", json={"name": "owl", **what}), 403, "needs admin")
            assert client.post(f"/v1/{kind}", json={"name": "mine"}).status_code == 201
    with site.client("larch", Scope.ADMIN) as client:
        assert client.get("/metrics").status_code == 200


def test_a_project_finds_nothing_of_another(site):
    """By any identifier on any route: as if it did not exist, to the word."""
    absent = {"capture": new_id(CAPTURE), "environment": new_id(ENVIRONMENT), "upload": new_id(UPLOAD), "job": new_id(JOB),
              "name": "maps.exr", "hook": new_id(HOOK), "annotation": new_id(ANNOTATION), "worker": "nothing-cpu-2"}
    walked = 0
    with site.client("willow") as client:
        for method, path in operations():
            if "{" not in path:
                continue
            theirs, nothing = (ask(client, method, path, names) for names in (site.ours, absent))
            walked += 1
            if method in CHANGES and theirs.status_code == 422:  # the empty body is looked at first
                assert nothing.status_code == 422
                continue
            assert theirs.status_code == nothing.status_code == 404, (method, path, theirs.text)
            if method != "head":
                assert in_general(theirs, site.ours) == in_general(nothing, absent), (method, path)
    assert walked > 15
    assert (site.server.data / "projects/larch/jobs" / site.ours["job"] / "maps.exr").exists()
    with site.client("larch") as client:
        assert client.get(f"/v1/jobs/{site.ours['job']}").json()["state"] == "queued"


def in_general(response: httpx2.Response, names: dict[str, str]) -> dict:
    """A problem, with names in place of identifiers and without that of the request."""
    text = response.text
    for name, value in names.items():
        text = text.replace(value, f"<{name}>")
    return json.loads(text) | {"request_id": ""}


def test_a_project_lists_names_and_registers_nothing_of_another(site):
    with site.client("willow") as client:
        for path in ("/v1/captures", "/v1/environments", "/v1/jobs"):
            assert next(value for value in client.get(path).raise_for_status().json().values() if isinstance(value, list)) == []
        for path, name, mine in (("captures", "capture", CAPTURE), ("environments", "environment", ENVIRONMENT), ("jobs", "job", JOB)):
            theirs = client.get(f"/v1/{path}", params={"before": site.ours[name]})
            absent = new_id(mine)
            nothing = client.get(f"/v1/{path}", params={"before": absent})
            assert theirs.status_code == nothing.status_code and theirs.status_code in (404, 422)
            assert in_general(theirs, {"it": site.ours[name]}) == in_general(nothing, {"it": absent})
    given = {"name": "owl", "folder": str(site.server.data.parent / "of-willow" / "owl")}
    with site.client("larch") as larch, site.client("willow") as willow:
        refused(larch.post("/v1/captures", json=given), 422, "folder: lies in none of the folders that the operator allows")
        assert willow.post("/v1/captures", json=given).status_code == 201


@pytest.mark.parametrize("job", [
    {"kind": "solve", "capture": "capture"}, {"kind": "relight", "capture": "capture", "environment": "environment"},
    {"kind": "export", "maps": "job", "rig": "capture"}, {"kind": "shade", "maps": "job", "environment": "environment"},
    {"kind": "view", "capture": "capture", "maps": "job"},
], ids=lambda job: job["kind"])
def test_a_job_cannot_read_what_is_anothers(site, job):
    made = {"capture": new_id(CAPTURE), "environment": new_id(ENVIRONMENT), "job": new_id(JOB)}
    with site.client("willow") as client:
        theirs = client.post("/v1/jobs", json={field: site.ours.get(value, value) for field, value in job.items()})
        nothing = client.post("/v1/jobs", json={field: made.get(value, value) for field, value in job.items()})
    assert theirs.status_code == nothing.status_code and theirs.status_code in (404, 422)
    assert in_general(theirs, {name: site.ours[name] for name in made}) == in_general(nothing, made)


@pytest.mark.long
def test_a_service_without_keys_answers_this_machine_and_no_form_of_another_site(server, client):
    port = server.url.rpartition(":")[2]
    for host in ("localhost", f"localhost:{port}", "127.0.0.1", "127.5.0.1:80", f"[::1]:{port}"):
        assert client.get("/v1/jobs", headers={"Host": host}).status_code == 200, host
    assert client.get("/v1/jobs", headers={"Origin": server.url}).status_code == 200
    assert client.get("/v1/jobs", headers={"Authorization": "Bearer key_x.y"}).status_code == 401  # a wrong key is no anonymous request
    # content types that a browser sends across sites without asking
    for kind in ("text/plain", "application/x-www-form-urlencoded", "multipart/form-data; boundary=x"):
        refused(client.post("/v1/captures", content=b'{"name": "x"}', headers={"Content-Type": kind}), 415, "the body must be JSON")


@pytest.mark.parametrize("headers", [
    {"Host": "relit.example.com"}, {"Host": "127.0.0.1.example.com"}, {"Host": "localhost.example.com:80"}, {"Host": "[::1"}, {"Host": ""},
    {"Host": "192.168.1.7:8470"}, {"Origin": "https://example.com"}, {"Origin": "null"}, {"Origin": "http://localhost:1"},
    {"X-Forwarded-For": "10.0.0.7"}, {"Forwarded": "for=10.0.0.7"}, {"Via": "1.1 proxy"},
], ids=lambda headers: " ".join(f"{name}: {value}" for name, value in headers.items()))
def test_a_service_without_keys_refuses_proxies_and_pages_of_other_sites(client, headers):
    """A name that was made to point at this machine, a form of another site, a proxy that lets the world in."""
    for path in ("/v1/jobs", "/metrics"):
        refused(client.get(path, headers=headers), 403, "without a key")
    refused(client.post("/v1/captures", json={"name": "x"}, headers=headers), 403, "without a key")
    assert client.get("/healthz", headers=headers).status_code == 200
