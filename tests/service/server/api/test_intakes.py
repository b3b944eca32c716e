"""Captures and environments: created or registered, looked at, checked, deleted."""

import shutil

import pytest

from service.requests.base.identifiers import CAPTURE, new_id
from service.requests.jobs import CheckJob
from service.server.database import intakes, jobs
from service.server.database.engine import connect
from service.server.database.jobs import Claim
from service.server.database.schema import upgrade
from tests.service.server.api.captures import write_capture
from tests.service.server.api.conftest import SAMPLES
from tests.service.server.api.job_calls import finish, submit


def test_a_capture_is_created_looked_at_and_deleted(client):
    answer = client.post("/v1/captures", json={"name": "new"})
    made = answer.json()
    assert (answer.status_code, answer.headers["location"]) == (201, f"/v1/captures/{made['id']}")
    assert (made["state"], made["registered"], made["problem"], made["facts"]) == ("receiving", False, None, None)
    assert client.get(f"/v1/captures/{made['id']}").json() == made
    assert client.delete(f"/v1/captures/{made['id']}").status_code == 204
    assert client.get(f"/v1/captures/{made['id']}").status_code == 404
    assert client.delete(f"/v1/captures/{made['id']}").status_code == 404


def test_a_registered_capture_is_checked_at_once_and_stays_where_it_lies(server, client, registered):
    folder = write_capture(registered / "kept")
    asked = {"name": "kept", "folder": str(folder)}
    made = client.post("/v1/captures", json=asked, headers={"Idempotency-Key": "kept"}).json()
    again = client.post("/v1/captures", json=asked, headers={"Idempotency-Key": "kept"}).json()
    assert again["id"] == made["id"]
    ready = server.wait(client, f"/v1/captures/{made['id']}", ("ready", "refused"))
    assert ready["facts"] == {"captures": 1, "frames": 4, "resolution": [8, 8], "color_space": "lin_rec709_scene", "name": "small"}
    assert client.post(f"/v1/captures/{made['id']}/validate").status_code == 409
    assert client.delete(f"/v1/captures/{made['id']}").status_code == 204
    assert (folder / "capture.json").is_file()


@pytest.mark.long
def test_a_registered_capture_that_was_mended_is_checked_again(server, client, registered):
    folder = write_capture(registered / "mended")
    kept = (folder / "001.exr").read_bytes()
    (folder / "001.exr").unlink()
    made = client.post("/v1/captures", json={"name": "mended", "folder": str(folder)}).json()["id"]
    assert "001.exr is not in the folder" in server.wait(client, f"/v1/captures/{made}", ("ready", "refused"))["problem"]
    (folder / "001.exr").write_bytes(kept)
    client.post(f"/v1/captures/{made}/validate").raise_for_status()
    assert server.wait(client, f"/v1/captures/{made}", ("ready", "refused"))["state"] == "ready"


def test_a_sequence_of_captures_is_one(server, client, registered):
    for step in ("step1", "step2"):
        write_capture(registered / "sequence" / step)
    made = client.post("/v1/captures", json={"name": "sequence", "folder": str(registered / "sequence")}).json()["id"]
    ready = server.wait(client, f"/v1/captures/{made}", ("ready", "refused"))
    assert (ready["facts"]["captures"], ready["facts"]["frames"]) == (2, 8)


@pytest.mark.long
@pytest.mark.parametrize("kind", ["captures", "environments"])
def test_what_has_no_file_is_refused(server, client, kind):
    made = client.post(f"/v1/{kind}", json={"name": "empty"}).json()["id"]
    client.post(f"/v1/{kind}/{made}/validate").raise_for_status()
    assert server.wait(client, f"/v1/{kind}/{made}", ("ready", "refused"))["state"] == "refused"


def test_captures_are_listed_in_pages(client):
    made = [client.post("/v1/captures", json={"name": f"page {number}"}).json()["id"] for number in range(3)]
    first = client.get("/v1/captures", params={"limit": 2}).json()
    second = client.get("/v1/captures", params={"limit": 2, "before": first["next"]}).json()
    assert [item["id"] for item in first["items"] + second["items"]][:3] == made[::-1]
    assert all(item["id"].startswith("env_") for item in client.get("/v1/environments").json()["items"])


@pytest.mark.long
def test_a_capture_that_a_job_reads_is_not_deleted(server, client, registered):
    folder = write_capture(registered / "read")
    made = client.post("/v1/captures", json={"name": "read", "folder": str(folder)}).json()["id"]
    sky = client.post("/v1/environments", json={"name": "sky", "file": str(SAMPLES / "owl/environment.exr")}).json()["id"]
    server.wait(client, f"/v1/captures/{made}", ("ready",))
    server.wait(client, f"/v1/environments/{sky}", ("ready",))
    job = client.post("/v1/jobs", json={"kind": "relight", "capture": made, "environment": sky, "priority": 0,
                                        "options": {"frames": "1-300"}}).raise_for_status().json()["id"]
    refused = client.delete(f"/v1/captures/{made}")
    assert (refused.status_code, job in refused.json()["detail"]) == (409, True)
    client.post(f"/v1/jobs/{job}/cancel").raise_for_status()
    server.wait(client, f"/v1/jobs/{job}", ("cancelled",))
    assert client.delete(f"/v1/captures/{made}").status_code == 204


def test_a_check_begins_again_by_another_validation_alone(server, client):
    made = client.post("/v1/captures", json={"name": "empty"}).json()["id"]
    client.post(f"/v1/captures/{made}/validate").raise_for_status()
    server.wait(client, f"/v1/captures/{made}", ("refused",))
    check = next(job for job in client.get("/v1/jobs").json()["jobs"] if job["request"].get("intake") == made)
    server.wait(client, f"/v1/jobs/{check['id']}", ("failed",))
    refused = client.post(f"/v1/jobs/{check['id']}/retry")
    assert (refused.status_code, made in refused.json()["detail"]) == (409, True)


@pytest.mark.parametrize("end", ["cancelled", "lost"])
def test_a_check_that_ends_unseen_leaves_nothing_waiting(tmp_path, end):
    """Cancelled, or the death of worker after worker: what it was to look at is refused, and does not check for ever."""
    database, capture = connect(f"sqlite:///{tmp_path / 'test.sqlite'}"), new_id(CAPTURE)
    upgrade(database)

    def begin(connection) -> str:
        intakes.insert(connection, identifier=capture, project="p", kind=CAPTURE, name="test", folder="/somewhere")
        return jobs.insert(connection, project="p", key=None, request=CheckJob(kind="check", intake=capture), chunk_frames=1,
                           inputs=[capture])

    job = database.transact(begin)
    if end == "cancelled":
        assert database.transact(lambda connection: jobs.cancel(connection, job))
    else:
        claim = Claim(job, 1, "worker")
        assert jobs.begin(database, claim)
        assert database.transact(lambda connection: jobs.record_lost_worker(connection, claim, 0)) == jobs.FAILED
    found = intakes.find(database, capture, "p")
    assert found is not None and found["state"] == "refused"
    assert ("cancelled" if end == "cancelled" else "lost 1 workers") in found["problem"]
    assert database.transact(lambda connection: intakes.begin_check(connection, capture))
    assert not database.transact(lambda connection: jobs.cancel(connection, job))
    found = intakes.find(database, capture, "p")
    assert found is not None and found["state"] == "checking"  # the check that ended before has no say in this one
    database.close()


@pytest.mark.parametrize(("kind", "more"), [
    ("solve", {}), ("depth", {}), ("scan", {"options": {"near_m": 1}}), ("basis", {}), ("inspect-board", {}),
    ("calibrate-saturation", {}),
])
def test_a_job_whose_registered_capture_is_gone_does_not_say_where_it_was(server, client, gone, kind, more):
    job = submit(client, kind=kind, capture=gone[0], **more)
    error = finish(server, client, job, "failed")["error"]
    log = client.get(f"/v1/jobs/{job['id']}/log").text
    assert gone[0] in error, error
    assert not any(str(place) in error + log for place in (gone[1], gone[1].parent, server.data)), error


@pytest.fixture(scope="module")
def gone(server, client, registered):
    """A capture that was registered and checked, whose folder was deleted since, and its folder."""
    folder = write_capture(registered / "gone")
    made = client.post("/v1/captures", json={"name": "gone", "folder": str(folder)}).raise_for_status().json()
    assert server.wait(client, f"/v1/captures/{made['id']}", ("ready", "refused"))["state"] == "ready"
    shutil.rmtree(folder)
    return made["id"], folder
