"""What becomes of jobs: those that fail, are tried again, cancelled, resumed or put first, and what their log says."""

import httpx2
import pytest

from tests.service.server.api.job_calls import NOBODY, finish, finished, has_made, made_by, refused, submit
from tests.service.waiting import until

pytestmark = pytest.mark.long


def test_a_job_that_fails_says_why_and_is_tried_again(server, client, dome):
    job = submit(client, kind="depth", capture=dome)  # has lights, and no patterns
    failed = finish(server, client, job, "failed")
    assert "none has a pattern with a code, a laser, tof or stereo" in failed["error"] and "\n" not in failed["error"]
    refused(client.post(f"/v1/jobs/{job['id']}/resume"), 409, "is failed, not cancelled")
    refused(client.post(f"/v1/jobs/{job['id']}/cancel"), 409, "is failed: it has ended")
    again = client.post(f"/v1/jobs/{job['id']}/retry")
    assert again.status_code == 202
    assert again.json()["attempt"] == 2 and again.json()["error"] is None and again.json()["state"] in ("queued", "running")
    assert finish(server, client, job, "failed")["error"] == failed["error"]


def test_a_job_that_runs_is_cancelled_and_the_next_begins(server, client, long, dome):
    job = submit(client, **long)
    has_made(client, job, 2)
    refused(client.delete(f"/v1/jobs/{job['id']}"), 409, "is running: cancel it first")
    cancelled = client.post(f"/v1/jobs/{job['id']}/cancel")
    assert (cancelled.status_code, cancelled.json()["state"]) == (202, "cancelled")
    until(lambda: any(line["event"] == "step stopped" and line.get("job") == job["id"] for line in server.lines()), "not stopped")
    frames = made_by(client, job)
    assert 2 <= len(frames) < 300
    finished(server, client, kind="solve", capture=dome, options={"method": "lambert"})
    assert made_by(client, job) == frames  # nobody works on it any more
    assert [line for line in server.lines() if line["level"] == "error"] == []
    assert client.get(f"/v1/jobs/{job['id']}").json() == cancelled.json()
    assert client.delete(f"/v1/jobs/{job['id']}").status_code == 204
    assert client.get(f"/v1/jobs/{job['id']}").status_code == 404
    assert not (server.data / "projects/default/jobs" / job["id"]).exists()
    # one that is deleted while it still runs: DBOS wrote a traceback, also since the workflow that it ends is not there any more
    job = submit(client, **long)["id"]
    server.wait(client, f"/v1/jobs/{job}", ("running",))
    client.post(f"/v1/jobs/{job}/cancel").raise_for_status()
    assert client.delete(f"/v1/jobs/{job}").status_code == 204
    until(lambda: any(line["event"] == "step stopped" and line.get("job") == job for line in server.lines()), "not stopped")
    finished(server, client, kind="solve", capture=dome, options={"method": "lambert"})
    assert [line for line in server.lines() if line["level"] == "error"] == []


def test_a_cancelled_job_goes_on_with_what_is_done(server, client, dome, sky):
    request = {"kind": "relight", "capture": dome, "environment": sky, "options": {"frames": "1-24", "spin_degrees": 360}}
    job = submit(client, **request, name="slow")
    has_made(client, job, 2)
    client.post(f"/v1/jobs/{job['id']}/cancel").raise_for_status()
    finished(server, client, kind="solve", capture=dome, options={"method": "lambert"})  # the worker is at the next job now
    folder = server.data / "projects/default/jobs" / job["id"]
    done = {path.name: (path.stat().st_ino, path.stat().st_mtime_ns) for path in folder.glob("frame.*.exr")}
    assert 2 <= len(done) < 24
    refused(client.post(f"/v1/jobs/{job['id']}/retry"), 409, "is cancelled, not failed")
    assert client.post(f"/v1/jobs/{job['id']}/resume").json()["attempt"] == 2
    ended = finish(server, client, job)
    assert (ended["progress"]["done"], ended["attempt"]) == (24, 2)
    assert {name: ((folder / name).stat().st_ino, (folder / name).stat().st_mtime_ns) for name in done} == done
    undisturbed = server.data / "projects/default/jobs" / finished(server, client, **request)["id"]
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == {path.name: path.read_bytes() for path in undisturbed.iterdir()}


def test_the_highest_priority_goes_first(server, client, long, dome):
    before = submit(client, **long, priority=100)
    has_made(client, before, 1)  # the worker is busy

    def wait(priority: int) -> dict:
        return submit(client, kind="solve", capture=dome, options={"method": "lambert"}, priority=priority)

    low, high, raised, equal, dropped = wait(10), wait(90), wait(5), wait(10), wait(100)
    changed = client.patch(f"/v1/jobs/{raised['id']}", json={"priority": 95})
    assert (changed.status_code, changed.json()["priority"], changed.json()["state"]) == (200, 95, "queued")
    refused(client.patch(f"/v1/jobs/{before['id']}", json={"priority": 1}), 409, "only a queued job has a priority to change")
    refused(client.patch(f"/v1/jobs/{low['id']}", json={"priority": 101}), 422, "less than or equal to 100")
    refused(client.patch(f"/v1/jobs/{low['id']}", json={}), 422, "is missing")
    client.post(f"/v1/jobs/{dropped['id']}/cancel").raise_for_status()
    client.post(f"/v1/jobs/{before['id']}/cancel").raise_for_status()
    began = {name: finish(server, client, job)["started_at"] for name, job in
             {"low": low, "high": high, "raised": raised, "equal": equal}.items()}
    assert sorted(began, key=began.get) == ["raised", "high", "low", "equal"]
    assert client.get(f"/v1/jobs/{dropped['id']}").json()["started_at"] is None
    refused(client.patch(f"/v1/jobs/{raised['id']}", json={"priority": 1}), 409, "is succeeded")


def texts(client: httpx2.Client, job: dict) -> list[str]:
    entries = client.get(f"/v1/jobs/{job['id']}/log").raise_for_status().json()["entries"]
    assert [entry["at"] for entry in entries] == sorted(entry["at"] for entry in entries)
    return [f"{entry['attempt']} {entry['text']}" for entry in entries]


def test_the_log_says_what_happened_and_goes_with_its_job(server, client, dome, long):
    solved = finished(server, client, kind="solve", capture=dome, options={"method": "lambert"})
    found = texts(client, solved)
    assert found[0] == "1 begun by a worker" and found[-1] == "1 succeeded"
    assert any(each.startswith("1 ingest, ") for each in found) and any(each.startswith("1 normals, ") for each in found)
    job = submit(client, **long)
    has_made(client, job, 1)
    client.post(f"/v1/jobs/{job['id']}/cancel").raise_for_status()
    client.post(f"/v1/jobs/{job['id']}/resume").raise_for_status()
    client.post(f"/v1/jobs/{job['id']}/cancel").raise_for_status()
    found = texts(client, job)
    assert found.index("1 cancelled") < found.index("2 queued again") < found.index("2 cancelled")
    failing = finish(server, client, submit(client, kind="solve", capture=dome, options={"align_to": "nothing.png"}), "failed")
    assert texts(client, failing)[-1] == f"1 failed: {failing['error']}"
    client.delete(f"/v1/jobs/{failing['id']}").raise_for_status()
    refused(client.get(f"/v1/jobs/{failing['id']}/log"), 404, "there is no")
    refused(client.get(f"/v1/jobs/{NOBODY}/log"), 404, "there is no")
