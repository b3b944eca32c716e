"""Deliveries to hooks: what is written when a job ends, and what is sent, to receivers that are away, slow or broken; hours pass by an
injected clock."""

import threading
from contextlib import ExitStack
from types import SimpleNamespace

import pytest

from service import __version__
from service.requests.answers import JobView
from service.requests.base.identifiers import CAPTURE, new_id
from service.requests.hooks import HookEvent
from service.requests.jobs import CheckJob
from service.requests.keys import Scope
from service.server.api.hooks import send_test
from service.server.api.problems import ApiError
from service.server.base import outgoing
from service.server.database import hooks, jobs
from service.server.database.jobs import Claim
from service.server.database.keys import Caller
from service.server.process.hook_sender import LEASE_S, OF_PROJECT, PATIENCE_S
from service.server.process.housekeeping import DELIVERY_S, GIVE_UP_S
from tests.service.server.process.hook_site import Site
from tests.service.server.process.house import PROJECT
from tests.service.server.receiver import receiving, verified
from tests.service.waiting import at_once, free_port, until


@pytest.fixture
def site(house) -> Site:
    return Site(house)


@pytest.fixture
def receiver():
    with receiving() as made:
        yield made


def test_the_end_of_a_job_is_told_signed_and_with_its_view(site, receiver):
    hook = site.hook(receiver.url)
    done, failed, cancelled = site.ended(), site.ended(jobs.FAILED), site.queued()
    assert site.database.transact(lambda connection: jobs.cancel(connection, cancelled))
    for _ in range(3):
        site.send()
    views = {job: JobView.of(jobs.find(site.database, job)) for job in (done, failed, cancelled)}
    told = {each.event["data"]["id"]: each for each in receiver.received}
    assert {job: each.event["type"] for job, each in told.items()} == {
        done: "job.finished", failed: "job.failed", cancelled: "job.cancelled"}
    for job, each in told.items():
        assert JobView.model_validate(each.event["data"]) == views[job]
        assert verified(hook["secret"], each)
        assert not verified("whsec_" + "A" * 43 + "=", each)
        assert not verified(hook["secret"], each._replace(body=each.body.replace(b"owl", b"elm")))
        assert not verified(hook["secret"], each._replace(headers=each.headers | {"webhook-id": "msg_other"}))
        assert each.headers["content-type"] == "application/json" and each.headers["user-agent"] == f"relit/{__version__}"
        assert site.log(job)[-1] == f"{hook['id']} told: 204"
    assert told[failed].event["data"]["error"] == "no light"
    assert len(set(receiver.ids())) == 3
    site.send(7 * 86_400)
    assert len(receiver.received) == 3


def test_a_job_whose_workers_died_is_told_and_a_check_is_not(site, receiver):
    site.hook(receiver.url)
    job = site.queued()
    for worker in ("one", "two"):
        claim = Claim(job, 1, worker)
        assert jobs.begin(site.database, claim)
        site.database.transact(lambda connection, claim=claim: jobs.record_lost_worker(connection, claim, 1))
    check = site.database.transact(lambda connection: jobs.insert(
        connection, project=PROJECT, request=CheckJob(kind="check", intake=new_id(CAPTURE))))
    assert site.database.transact(lambda connection: jobs.cancel(connection, check))
    site.send()
    site.send()
    event, = [each.event for each in receiver.received]
    assert (event["type"], event["data"]["id"]) == ("job.failed", job) and "lost 2 workers" in event["data"]["error"]


def test_a_receiver_that_is_away_is_told_when_it_is_there_with_one_identifier_and_body(site, monkeypatch):
    port = free_port()
    hook = site.hook(f"http://127.0.0.1:{port}/")
    job = site.ended()
    site.send()
    assert "no answer" in site.last(hook)["answer"] and site.last(hook)["state"] == "waiting"
    upgraded = JobView.model_dump
    monkeypatch.setattr(JobView, "model_dump", lambda view, **options: upgraded(view, **options) | {"field": "of a later version"})
    with receiving(port=port) as receiver:
        receiver.status = 500
        site.send(4.0)  # before the pause has passed
        assert receiver.received == []
        site.send(2.0)
        site.send(23.0)
        assert (site.last(hook)["answer"], site.last(hook)["tries"]) == ("500", 3)
        receiver.status = 302
        site.send(89.0)
        assert site.last(hook)["answer"] == "302: redirects are not followed"
        receiver.status = 200
        site.send(353.0)
        assert (site.last(hook)["state"], site.last(hook)["body"]) == ("delivered", None)
        assert len(set(receiver.ids())) == 1 and len({each.body for each in receiver.received}) == 1
        assert "field" not in receiver.received[0].event["data"]  # which is from before the upgrade
        times = [int(each.headers["webhook-timestamp"]) for each in receiver.received]
        assert times == sorted(set(times))  # each try is signed anew
        assert all(verified(hook["secret"], each, at) for each, at in zip(receiver.received, times, strict=True))
        assert not verified(hook["secret"], receiver.received[0], times[-1])  # too old by then
        site.send(86_400)
        assert len(receiver.received) == 4
    assert [line.partition(": ")[0] for line in site.log(job)[-2:]] == [f"{hook['id']} not told, tried again", f"{hook['id']} told"]


def test_a_receiver_that_never_answers_well_is_given_up_within_two_days(site, receiver):
    hook = site.hook(receiver.url)
    job = site.ended()
    receiver.status, began = 404, site.house.now
    while site.last(hook)["state"] == "waiting":
        site.house.now = max(site.house.now, site.due_at(hook))
        site.send()
    assert (site.last(hook)["state"], len(receiver.received), site.last(hook)["body"]) == ("given_up", 14, None)
    assert 43 * 3600 < site.house.now - began < 48 * 3600
    assert site.log(job)[-1] == f"{hook['id']} given up after 14 tries: 404"
    site.send(86_400)
    assert len(receiver.received) == 14
    site.house.round()
    assert site.last(hook)["state"] == "given_up"
    site.tidy(DELIVERY_S)
    assert hooks.last_delivery(site.database, hook["id"]) is None


def test_a_slow_receiver_holds_no_other_and_gets_one_request_at_a_time(site, receiver):
    with receiving() as slow:
        slow.held = threading.Event()
        site.hook(slow.url, HookEvent.FINISHED)
        site.hook(receiver.url)
        site.ended(jobs.FAILED)
        for _ in range(2):
            site.ended()
        site.pass_time()
        for count in (1, 2, 3):
            until(lambda count=count: site.sender.round() or len(receiver.received) >= count, "held by the slow one")
        until(lambda: slow.received)
        assert len(slow.received) == 1
        slow.held.set()
        site.sender.wait()
        site.send()
        assert len(set(slow.ids())) == 2


def test_slow_receivers_and_another_take_turns(site, receiver):
    """One more hook than a project has requests: when a slow receiver has answered, the other is told before the slow one's next event."""
    answers = threading.Semaphore(0)
    with ExitStack() as stack:
        slow = [stack.enter_context(receiving()) for _ in range(OF_PROJECT)]
        stack.callback(answers.release, 100)
        for each in slow:
            each.status = lambda _: 204 if answers.acquire(timeout=60) else 500
            site.hook(each.url, HookEvent.FAILED)
        for _ in range(3):
            site.ended(jobs.FAILED)
        site.pass_time()
        site.sender.round()
        until(lambda: all(each.received for each in slow))
        site.hook(receiver.url)
        site.ended()
        site.pass_time()
        site.sender.round()
        assert receiver.received == []  # the project has its share
        answers.release()
        until(lambda: site.sender.round() or receiver.received or sum(len(each.received) for each in slow) > OF_PROJECT)
        assert receiver.received


def test_a_hook_pauses_as_a_whole_and_goes_on_at_once_when_its_receiver_is_back(site, receiver):
    hook = site.hook(receiver.url)
    ended = [site.ended() for _ in range(3)]
    receiver.status = 503
    for later_s, count in ((0.0, 1), (1.0, 1), (5.0, 2), (15.0, 2), (8.0, 3), (60.0, 3), (30.0, 4)):  # pauses of 5, 20 and 80 s
        site.send(later_s)
        assert len(receiver.received) == count
    assert len(set(receiver.ids())) == 3  # each in its turn
    receiver.status = 204
    site.send(60.0)
    assert len(receiver.received) == 4
    site.database.transact(lambda connection: hooks.record_test(connection, PROJECT, hook["id"]))  # which ends the pause
    for _ in range(4):
        site.send()
    told = [each.event for each in receiver.received[4:]]
    assert told[0]["type"] == "hook.test" and {each["data"]["id"] for each in told[1:]} == set(ended)
    assert hooks.count_waiting(site.database, hook["id"]) == 0


def test_an_event_that_is_refused_holds_no_others(site, receiver):
    site.hook(receiver.url)
    refused = site.ended(jobs.FAILED)
    receiver.status = lambda each: 500 if each.event["type"] == "job.failed" else 204
    site.send()
    others = [site.ended() for _ in range(3)]
    site.send(6.0)
    for _ in range(3):
        site.send()
    assert [each.event["data"]["id"] for each in receiver.received] == [refused, *others, refused]


def test_what_waits_is_bounded_by_age_and_number(site, receiver, monkeypatch):
    monkeypatch.setattr(hooks, "MOST_WAITING", 2)
    hook = site.hook(receiver.url)
    receiver.status = 500
    ended = [site.ended() for _ in range(4)]
    site.send()
    site.house.round()
    assert hooks.count_waiting(site.database, hook["id"]) == 2
    assert [site.log(job)[-1] for job in ended[:2]] == [
        f"{hook['id']} given up after 1 tries: 500", f"{hook['id']} given up after 0 tries: not tried"]
    site.tidy(GIVE_UP_S)
    assert hooks.count_waiting(site.database, hook["id"]) == 0 and "given up" in site.log(ended[3])[-1]
    receiver.status = 204
    done = site.ended()
    site.send(86_400)
    assert receiver.received[-1].event["data"]["id"] == done and len(receiver.received) == 2


def test_a_delivery_that_fails_within_relit_is_given_up_too(site, monkeypatch):
    def fails(*_: object) -> None:
        raise UnicodeError("label empty or too long")

    hook = site.hook("https://tracker.example/")
    job = site.ended()
    monkeypatch.setattr(outgoing, "post", fails)
    for _ in range(14):
        site.send(8 * 3600)
    assert site.last(hook)["state"] == "given_up"
    assert site.log(job)[-1] .startswith(f"{hook['id']} given up after 14 tries: it could not be sent")


def test_a_machine_without_threads_to_spare_sends_later(site, receiver, monkeypatch):
    def fails(_thread: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    site.hook(receiver.url)
    site.ended()
    site.pass_time()
    with monkeypatch.context() as full:
        full.setattr(threading.Thread, "start", fails)
        with pytest.raises(RuntimeError, match="new thread"):
            site.sender.round()
    site.send(LEASE_S)
    assert len(receiver.received) == 1


def test_a_hook_that_is_deleted_while_its_test_is_asked_for_is_missed(site):
    hook = site.hook("https://tracker.example/")
    limiter = SimpleNamespace(take=lambda *_: site.database.transact(lambda connection: hooks.remove(connection, PROJECT, hook["id"])))
    caller = Caller(PROJECT, Scope.ADMIN, None)
    with pytest.raises(ApiError, match=f"there is no {hook['id']}"):
        send_test(SimpleNamespace(database=site.database, limiter=limiter), caller, hook["id"])


def test_of_several_senders_one_tells_and_what_a_killed_one_took_is_sent_again(site, receiver):
    site.hook(receiver.url)
    for _ in range(4):
        site.ended()
    site.pass_time()
    senders = [site.new_sender() for _ in range(4)]
    for _ in range(8):
        at_once(4, lambda number: senders[number].round())
        for sender in senders:
            sender.wait()
    assert len(receiver.received) == len(set(receiver.ids())) == 4
    site.ended()
    site.pass_time()
    row, = hooks.due(site.database, site.house.now)
    taken = site.take(row["id"])  # and it is killed
    site.send()
    assert len(receiver.received) == 4
    site.send(LEASE_S)
    assert receiver.ids()[4:] == [taken["id"]]
    assert LEASE_S > outgoing.TIMEOUT_S + PATIENCE_S  # a try that is alive is not sent again


def test_the_result_of_a_sender_that_woke_too_late_is_not_recorded(site, receiver):
    hook = site.hook(receiver.url)
    site.ended()
    site.pass_time()
    row, = hooks.due(site.database, site.house.now)
    late = site.take(row["id"])
    site.send(LEASE_S)
    assert not site.database.transact(lambda connection: hooks.settle(connection, late, state="waiting", answer="500", due_at=0.0))
    assert site.last(hook)["state"] == "delivered"


def test_a_project_hears_of_its_own_jobs_and_a_deleted_hook_of_none(site, receiver):
    with receiving() as other:
        hook = site.hook(receiver.url)
        site.hook(other.url, project="willow")
        mine, theirs = site.ended(), site.ended(project="willow")
        site.send()
        assert [each.event["data"]["id"] for each in receiver.received] == [mine]
        assert [each.event["data"]["id"] for each in other.received] == [theirs]
        receiver.status = 500
        site.ended()
        site.send()
        assert not site.database.transact(lambda connection: hooks.remove(connection, "willow", hook["id"]))
        assert site.database.transact(lambda connection: hooks.remove(connection, PROJECT, hook["id"]))
        site.ended()
        site.send(60.0)
        assert len(receiver.received) == 2 and hooks.due(site.database, site.house.now + 86_400) == []


def test_what_is_not_ended_is_not_told(site, receiver):
    """The delivery is a part of the transaction: where it is rolled back, there is none."""
    site.hook(receiver.url)
    job = site.queued()

    def work(connection) -> None:
        assert jobs.cancel(connection, job)
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        site.database.transact(work)
    site.send()
    assert receiver.received == [] and jobs.find(site.database, job)["state"] == "queued"
