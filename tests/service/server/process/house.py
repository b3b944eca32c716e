"""A service without processes, and its housekeeper; days pass by an injected clock."""

import time
from pathlib import Path

import sqlalchemy as sa

from service.requests.base.identifiers import CAPTURE, new_id
from service.requests.jobs import SolveJob
from service.server.base.settings import Settings
from service.server.database import intakes, jobs, tables
from service.server.database.engine import connect
from service.server.jobs.queue import JobQueue
from service.server.process.housekeeping import Housekeeper
from service.server.storage import layout
from service.server.storage.objects import open_storage
from tests.service.server.prepared import prepare

DAYS = 30.0
PROJECT = "larch"


class House:
    """A service without processes, and its housekeeper."""

    def __init__(self, data: Path, **settings: object) -> None:
        self.settings = Settings(data=data, **settings)
        self.database = connect(self.settings.sqlalchemy_url)
        prepare(self.settings, self.database)
        self.storage, self.queue = open_storage(self.settings), JobQueue(self.database)
        self.now, self.jumped = time.time(), 0.0
        self.keeper = Housekeeper(self.settings, self.database, self.storage, self.queue, clock=lambda: self.now,
                                  monotonic=lambda: self.now - self.jumped)

    def round(self, later_s: float = 0.0) -> None:
        """Keep house after some time."""
        self.now += later_s
        self.keeper.round()

    def capture(self, kind: str = CAPTURE) -> str:
        return self.database.transact(lambda connection: intakes.insert(connection, project=PROJECT, kind=kind, name="x"))

    def job(self, state: str = jobs.SUCCEEDED, *, inputs: tuple[str, ...] = (), request=None) -> str:
        request = request or SolveJob(kind="solve", capture=inputs[0] if inputs else new_id(CAPTURE))
        made = self.database.transact(lambda connection: self.queue.submit(connection, project=PROJECT, request=request, inputs=inputs))
        self.database.transact(lambda connection: connection.execute(tables.jobs.update().where(tables.jobs.c.id == made).values(
            state=state, finished_at=self.now if state in jobs.ENDED else None)))
        (self.results(made)).mkdir(parents=True)
        (self.results(made) / "maps.exr").write_bytes(b"maps")
        return made

    def results(self, job: str) -> Path:
        return self.settings.data / layout.results(PROJECT, job)

    def cache(self, capture: str, size: int = 1000) -> Path:
        folder = self.settings.data / "cache" / capture
        folder.mkdir(parents=True)
        (folder / "stack.npy").write_bytes(b"\0" * size)
        return folder

    def workflows(self) -> set[str]:
        """What the queue knows, in its own table."""
        table = "workflow_status" if self.database.is_sqlite else "dbos.workflow_status"
        return {row["workflow_uuid"] for row in self.database.rows(sa.select(sa.text("workflow_uuid")).select_from(sa.text(table)))}
