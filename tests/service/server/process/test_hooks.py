"""Deliveries to hooks: what is written when a job ends, and what is sent, to receivers that are away, slow or broken; hours pass by an
injected clock."""

import threading
import time

import pytest

from service import __version__
from service.requests.answers import JobView
from service.requests.base.identifiers import CAPTURE, new_id
from service.requests.hooks import HookEvent, NewHook
from service.requests.jobs import CheckJob, SolveJob
from service.server.api.views import job_view
from service.server.database import hooks, jobs
from service.server.database.jobs import Claim
from service.server.process.hook_sender import HookSender
from service.server.process.housekeeping import DELIVERY_S
from tests.service.server.process.house import PROJECT, House
from tests.service.server.receiver import receiving, verified
from tests.service.waiting import at_once, free_port, until

LOOPBACK = ("127.0.0.0/8",)


class Site:
    """A service without processes, its hooks, and a sender."""

    def __init__(self, house: House) -> None:
        self.house, self.database = house, house.database
        self.settings = house.settings.model_copy(update={"hook_networks": LOOPBACK})
        self.sender = self.new_sender()

    def new_sender(self) -> HookSender:
        return HookSender(self.settings, self.database, clock=lambda: self.house.now)

    def hook(self, url: str, *events: HookEvent, project: str = PROJECT):
        wanted = NewHook(url=url, events=events) if events else NewHook(url=url)
        return self.database.transact(lambda connection: hooks.insert(connection, project, wanted))

    def queued(self, project: str = PROJECT) -> str:
        return self.database.transact(lambda connection: self.house.queue.submit(
            connection, project=project, key=None, request=SolveJob(kind="solve", capture=new_id(CAPTURE), name="owl"), chunk_frames=8,
            inputs=[]))

    def ended(self, state: str = jobs.SUCCEEDED, project: str = PROJECT) -> str:
        job = self.queued(project)
        claim = Claim(job, 1, "worker")
        assert jobs.begin(self.database, claim)
        assert jobs.end(self.database, claim, state, "no light" if state == jobs.FAILED else None)
        return job

    def send(self, later_s: float = 0.0) -> None:
        """Try what is due after some time."""
        self.pass_time(later_s)
        self.sender.round()
        self.sender.wait()

    def pass_time(self, later_s: float = 0.0) -> None:
        """Set the injected clock on, and not behind the machine's, which the ends of jobs have."""
        self.house.now = max(self.house.now, time.time()) + later_s

    def last(self, hook) -> dict:
        return dict(hooks.last_delivery(self.database, hook["id"]))

    def log(self, job: str) -> list[str]:
        return [row["text"] for row in jobs.log_of(self.database, job)]


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
    views = {job: job_view(jobs.find(site.database, job)) for job in (done, failed, cancelled)}
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
        connection, project=PROJECT, key=None, request=CheckJob(kind="check", intake=new_id(CAPTURE)), chunk_frames=1, inputs=[]))
    assert site.database.transact(lambda connection: jobs.cancel(connection, check))
    site.send()
    site.send()
    event, = [each.event for each in receiver.received]
    assert (event["type"], event["data"]["id"]) == ("job.failed", job) and "lost 2 workers" in event["data"]["error"]


def test_a_receiver_that_is_away_is_told_when_it_is_there_with_one_identifier(site):
    port = free_port()
    hook = site.hook(f"http://127.0.0.1:{port}/")
    job = site.ended()
    site.send()
    assert "no answer" in site.last(hook)["answer"] and site.last(hook)["state"] == "waiting"
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
        assert (site.last(hook)["state"], site.last(hook)["due_at"]) == ("delivered", None)
        assert len(set(receiver.ids())) == 1 and len({each.body for each in receiver.received}) == 1
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
        site.house.now = max(site.house.now, site.last(hook)["due_at"])
        site.send()
    assert (site.last(hook)["state"], len(receiver.received)) == ("given_up", 14)
    assert 43 * 3600 < site.house.now - began < 48 * 3600
    assert site.log(job)[-1] == f"{hook['id']} given up after 14 tries: 404"
    site.send(86_400)
    assert len(receiver.received) == 14
    site.house.keeper.round()
    assert site.last(hook)["state"] == "given_up"
    site.house.now += DELIVERY_S
    site.house.keeper.round()
    site.house.now += 86_400  # the clock jumped: for a day nothing is removed
    site.house.keeper.round()
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
    assert site.database.transact(lambda connection: hooks.take(connection, row["id"], site.house.now)) is not None  # and it is killed
    site.send()
    assert len(receiver.received) == 4
    site.send(hooks.LEASE_S)
    assert receiver.ids()[4:] == [row["id"]]


def test_the_result_of_a_sender_that_woke_too_late_is_not_recorded(site, receiver):
    hook = site.hook(receiver.url)
    site.ended()
    site.pass_time()
    row, = hooks.due(site.database, site.house.now)
    late = site.database.transact(lambda connection: hooks.take(connection, row["id"], site.house.now))
    site.send(hooks.LEASE_S)
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
