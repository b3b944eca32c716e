"""A service without processes, whose hooks are sent by hand: hours pass by an injected clock."""

import time

from service.requests.base.identifiers import CAPTURE, new_id
from service.requests.hooks import HookEvent, NewHook
from service.requests.jobs import SolveJob
from service.server.database import hooks, jobs
from service.server.database.jobs import Claim
from service.server.process.hook_sender import LEASE_S, HookSender
from tests.service.server.process.house import PROJECT, House

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
            connection, project=project, request=SolveJob(kind="solve", capture=new_id(CAPTURE), name="owl")))

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

    def take(self, hook: str):
        now = self.house.now
        return self.database.transact(lambda connection: hooks.take(connection, hook, now=now, until=now + LEASE_S))

    def last(self, hook) -> dict:
        return dict(hooks.last_delivery(self.database, hook["id"]))

    def due_at(self, hook) -> float:
        return hooks.listing(self.database, PROJECT, hook["id"])[0]["due_at"]

    def tidy(self, later_s: float) -> None:
        for seconds in (0.0, later_s, 86_400):  # the clock jumped: for a day nothing is removed
            self.house.round(seconds)

    def log(self, job: str) -> list[str]:
        return [row["text"] for row in jobs.log_of(self.database, job)]
