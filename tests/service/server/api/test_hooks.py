"""The routes of hooks, and hooks of a real service: set, tested, told while jobs go on, after a kill, and deleted."""

import json
import os
import re
import signal
import threading
from pathlib import Path

import pytest

from service.requests.base.identifiers import new_id
from service.requests.keys import Scope
from service.server.database import audit
from service.server.database.tables import hooks
from tests.service.server.api.job_calls import accepted, finish, refused, submit
from tests.service.server.receiver import receiving, verified
from tests.service.server_process import serving
from tests.service.waiting import until

SAMPLES = Path(__file__).resolve().parents[4] / "samples"
DOCS = Path(__file__).resolve().parents[4] / "docs" / "service.md"
LOOPBACK = "127.0.0.0/8"


def test_hooks_are_set_seen_and_deleted_by_admins_of_their_project_alone(keyed, keyed_database):
    admin, writer, other = (keyed.client(keyed.key(*who)) for who in (
        ("alder", Scope.ADMIN), ("alder", Scope.WRITE), ("beech", Scope.ADMIN)))
    with admin, writer, other:
        wanted = {"url": "https://tracker.example/relit", "events": ["failed", "cancelled"]}
        made = admin.post("/v1/hooks", json=wanted)
        assert made.status_code == 201
        hook = made.json()
        assert made.headers["Location"] == f"/v1/hooks/{hook['id']}" and re.fullmatch(r"whsec_[A-Za-z0-9+/]{43}=", hook["secret"])
        seen = {name: value for name, value in hook.items() if name != "secret"}
        assert admin.get(f"/v1/hooks/{hook['id']}").json() == seen and admin.get("/v1/hooks").json() == {"hooks": [seen]}
        assert (seen["events"], seen["waiting"], seen["last_delivery"]) == (["failed", "cancelled"], 0, None)
        for ask in (lambda: writer.get("/v1/hooks"), lambda: writer.post("/v1/hooks", json=wanted),
                    lambda: writer.delete(f"/v1/hooks/{hook['id']}")):
            refused(ask(), 403, "this needs admin")
        assert other.get("/v1/hooks").json() == {"hooks": []}
        for ask in (other.get, other.delete, lambda path: other.post(f"{path}/test")):
            refused(ask(f"/v1/hooks/{hook['id']}"), 404, f"there is no {hook['id']} in this project")
        assert admin.delete(f"/v1/hooks/{hook['id']}").status_code == 204
        refused(admin.delete(f"/v1/hooks/{hook['id']}"), 404, "there is no hook_")
        refused(admin.post(f"/v1/hooks/{new_id('hook')}/test"), 404, "there is no hook_")
    # others of this service's tests have left lines of their own
    actions = [line["action"] for line in audit.listing(keyed_database, project="alder", limit=9) if line["object"] == hook["id"]]
    assert actions == ["hook.delete", "hook.create"]


@pytest.mark.parametrize(("wanted", "words"), [
    ({"url": "https://127.0.0.1/x"}, "url: 127.0.0.1 is not a public address, and no network of the setting hook_networks has it"),
    ({"url": "http://93.184.215.14/x"}, "give https://"),
    ({"url": "http://tracker.example/x"}, "hook_networks, which this service has none of: give https://"),
    ({"url": "tracker"}, 'url: is \"tracker\": give https://host/path'),
    ({"url": "https://me:word@tracker.example/"}, "is not of the form"),
    ({"url": "ftp://tracker.example/"}, "body.url"), ({"url": "https://a b/"}, "body.url"),
    ({"url": "https://tracker.example/", "events": []}, "body.events"),
    ({"url": "https://tracker.example/", "events": ["begun"]}, "body.events")])
def test_bad_hooks_are_refused_in_one_sentence(keyed, wanted, words):
    with keyed.client(keyed.key("alder")) as client:
        refused(client.post("/v1/hooks", json=wanted), 422, words)


def test_hooks_have_a_quota(keyed):
    with keyed.client(keyed.key("cedar")) as client:
        made = [client.post("/v1/hooks", json={"url": "https://tracker.example/"}) for _ in range(17)]
        assert [answer.status_code for answer in made] == [201] * 16 + [429]
        refused(made[-1], 429, "quota max_project_hooks: the project cedar has 16 of 16 hooks, and this needs 1 more")


@pytest.mark.long
def test_jobs_go_on_while_a_receiver_holds_the_request_and_it_hears_of_all_in_the_end(server, client):
    with receiving() as receiver:
        receiver.held = threading.Event()
        hook = client.post("/v1/hooks", json={"url": receiver.url}).raise_for_status().json()
        try:
            jobs = [submit(client, kind="patterns", options={"code": "gray", "projector": [64, 48]}) for _ in range(3)]
            for job in jobs:
                finish(server, client, job)
                until(lambda: receiver.received)
            assert len(set(receiver.ids())) == 1 and not receiver.held.is_set()  # on a slow machine a second try of the same
            receiver.held.set()
            client.post(f"/v1/hooks/{hook['id']}/test").raise_for_status()  # which ends the pause after a try that was not answered
            until(lambda: client.get(f"/v1/hooks/{hook['id']}").json()["waiting"] == 0)
        finally:
            client.delete(f"/v1/hooks/{hook['id']}")
        told = {each.event["data"]["id"]: each for each in receiver.received if each.event["type"] != "hook.test"}
        assert told.keys() == {job["id"] for job in jobs}
        for job, each in told.items():
            assert verified(hook["secret"], each) and each.event["type"] == "job.finished"
            assert each.event["data"] == client.get(f"/v1/jobs/{job}").json()
            until(lambda job=job: client.get(f"/v1/jobs/{job}/log").json()["entries"][-1]["text"] == f"{hook['id']} told: 204")


@pytest.mark.long
@pytest.mark.parametrize("database_url", ["postgresql"], indirect=True)
def test_a_server_that_is_killed_after_the_end_of_a_job_tells_it_when_it_runs_again(tmp_path, database_url):
    settings = {"roots": str(SAMPLES), "hook_networks": LOOPBACK} | ({} if database_url is None else {"database_url": database_url})
    options = ("--anonymous", "--device", "none")
    with receiving() as receiver:
        receiver.held = threading.Event()
        with serving(tmp_path, *options, **settings) as server, server.client() as client, server.database() as database:
            capture = accepted(database, client, "default", SAMPLES / "owl")
            hook = client.post("/v1/hooks", json={"url": receiver.url, "events": ["cancelled"]}).raise_for_status().json()
            job = submit(client, kind="solve", capture=capture)
            assert client.post(f"/v1/jobs/{job['id']}/cancel").status_code == 202
            until(lambda: receiver.received)  # and it does not answer
            os.killpg(server.process.pid, signal.SIGKILL)
            server.process.wait()
            # the hook is the killed server's for a minute more, as test_of_several_senders_one_tells proves: no test waits for it
            database.transact(lambda connection: connection.execute(hooks.update().values(due_at=0)))
        receiver.held.set()
        with serving(tmp_path, *options, **settings) as server, server.client() as client:
            until(lambda: client.get(f"/v1/hooks/{hook['id']}").json()["waiting"] == 0)
            last = client.get(f"/v1/hooks/{hook['id']}").json()["last_delivery"]
            assert (last["state"], last["answer"], last["job"], last["event"]) == ("delivered", "204", job["id"], "cancelled")
        assert receiver.ids() == [last["id"]] * 2  # a replay, known by its identifier
        assert receiver.received[0].body == receiver.received[1].body
        assert all(verified(hook["secret"], each) for each in receiver.received)


@pytest.mark.long
def test_the_commands_set_test_list_and_delete_a_hook_and_the_example_of_the_docs_verifies_it(server, relit, monkeypatch):
    monkeypatch.setenv("RELIT_SERVER", server.url)
    with receiving() as receiver:
        made = relit("hooks", "create", "--url", receiver.url, "--events", "failed,cancelled").out
        hook, secret = (re.search(rf"^{name} +(\S+)$", made, re.MULTILINE)[1] for name in ("hook", "secret"))
        delivery = re.search(r"msg_\w+", relit("hooks", "test", hook).well())[0]
        until(lambda: "204" in relit("hooks", "list").well())
        line = next(line for line in relit("hooks", "list").well().splitlines() if line.startswith(hook))
        assert "failed,cancelled" in line and receiver.url in line and line.split()[2] == "0"
        assert f"deleted     {hook}" in relit("hooks", "delete", hook).well()
        assert hook not in relit("hooks", "list").well()
        assert "there is no" in relit.refused("hooks", "delete", hook)
    received, = receiver.received
    assert received.id == delivery and json.loads(received.body) == received.event | {"type": "hook.test", "data": {"hook": hook}}
    names: dict = {"__name__": "example"}
    exec(re.search(r"```python\n(.*?)```", DOCS.read_text(), re.DOTALL)[1].replace("whsec_…", secret), names)
    assert names["is_genuine"](received.headers, received.body)
    assert not names["is_genuine"](received.headers, received.body + b" ")
    assert not names["is_genuine"](received.headers | {"webhook-timestamp": "1700000000"}, received.body)
