"""Watching jobs: one query per tick serves all listeners, however many there are."""

import asyncio
import threading
import time
from typing import NamedTuple

import sqlalchemy as sa

from service.requests.answers import JobView
from service.requests.base.identifiers import JOB
from service.requests.states import ENDED
from service.server.api.problems import RETRY_S, ApiError
from service.server.base.log import logger
from service.server.database import jobs, keys
from service.server.database.engine import UNANSWERED, Database, message_of
from service.server.database.keys import Caller

TICK_S = 0.25
"""Seconds between two queries; of several changes between them, the last is sent."""
KEYS_S = 2.0
"""Seconds for which the keys of streams count as valid while nothing changes; before a change is sent they are looked at in any case."""
MAX_STREAMS = 4096
"""Listeners of this process at most."""
MAX_PENDING = 2000
"""Changed jobs that a listener has not taken at most: the stream of a slower one ends, and its client connects again."""


class Change(NamedTuple):
    """A change of a job."""

    job: str
    revision: int
    ended: bool
    data: str | None
    """A JobView as JSON; None: the job was deleted."""


class Listener:
    """A listener to a job or to all jobs of a project. It keeps only the last change of each job."""

    def __init__(self, topic: str, after: int, caller: Caller | None = None) -> None:
        """Listen to a job or a project; `after` is the revision of the job that the client has. Without a caller it is this program."""
        self.topic, self.caller, self.fresh = topic, caller, True
        self._after = after
        self._pending: dict[str, Change] = {}
        self._closed = False
        self._news = asyncio.Event()

    def offer(self, change: Change) -> None:
        """Keep a change until it is taken."""
        if change.data is None or change.revision > self._after:
            self._pending[change.job] = change
            self._news.set()
        if len(self._pending) > MAX_PENDING:
            self.close()

    def close(self) -> None:
        """End the stream of this listener."""
        self._closed = True
        self._news.set()

    async def take(self, within_s: float) -> list[Change] | None:
        """Return the changes since the last call; an empty list if none came in time; None if the stream is to end."""
        if not self._news.is_set():
            try:
                await asyncio.wait_for(self._news.wait(), within_s)
            except TimeoutError:
                return []
        self._news.clear()
        if self._closed:
            return None
        taken, self._pending = list(self._pending.values()), {}
        return taken


class Watcher:
    """Queries the jobs that have listeners. Everything except the queries runs in the event loop."""

    def __init__(self, database: Database, closing: threading.Event, *, most: int = MAX_STREAMS) -> None:
        self._database, self._closing, self._most = database, closing, most
        self._listeners: dict[str, set[Listener]] = {}
        self._seen: dict[str, tuple[str, int]] = {}  # project and revision of jobs as they were told last
        self._task: asyncio.Task[None] | None = None
        self._keys_until = 0.0

    def listen(self, topic: str, *, after: int = 0, caller: Caller | None = None) -> Listener:
        """Add a listener to a job, or to the jobs of a project that have not ended or ended lately; `remove` must remove it."""
        if self._closing.is_set() or len(self._all()) >= self._most:
            raise ApiError("unavailable", "no further stream of events can be opened here now", headers={"Retry-After": str(RETRY_S)})
        listener = Listener(topic, after, caller)
        self._listeners.setdefault(topic, set()).add(listener)
        if self._task is None or self._task.done():
            self._task = asyncio.get_running_loop().create_task(self._run())
        return listener

    def remove(self, listener: Listener) -> None:
        """Remove a listener."""
        others = self._listeners.get(listener.topic, set())
        others.discard(listener)
        if not others:
            self._listeners.pop(listener.topic, None)

    async def _run(self) -> None:
        silent = False
        try:
            while self._listeners and not self._closing.is_set():
                try:
                    await self._look()
                    if silent:
                        logger.info("database answers again: events go on")
                    silent = False
                except UNANSWERED as error:
                    if not silent:
                        logger.warning("database does not answer: events wait", error=message_of(error))
                    silent = True
                await asyncio.sleep(TICK_S)
        except Exception as error:
            logger.error("watching jobs failed: streams of events end", exc_info=error)
        finally:  # no listener waits for ever
            self._seen = {}
            for listener in self._all():
                listener.close()

    async def _look(self) -> None:
        present, topics, known = set(self._all()), list(self._listeners), set(self._seen)  # who comes now is served next
        found = {row["id"]: row for row in await asyncio.to_thread(jobs.watched, self._database, topics)}
        fresh = {listener.topic for listener in present if listener.fresh}
        changed = {job for job, row in found.items() if job in fresh or row["project"] in fresh or job not in self._seen
                   or self._seen[job][1] != row["revision"]}
        missing = (known | {topic for topic in fresh if topic.startswith(f"{JOB}_")}) - set(found)  # deleted, or ended some time ago
        rows = await asyncio.to_thread(jobs.revisions, self._database, list(changed | missing)) if changed | missing else {}
        await self._close_revoked(now=bool(changed | missing))
        for job in changed | missing:
            self._tell(job, rows.get(job), present)
        self._seen = {job: (row["project"], rows.get(job, row)["revision"]) for job, row in found.items()
                      if job not in changed or job in rows}
        for listener in present:
            listener.fresh = False

    async def _close_revoked(self, *, now: bool) -> None:
        """End the streams of keys and tokens that were revoked or have expired; unless `now`, look at the keys every KEYS_S only."""
        if not now and time.monotonic() < self._keys_until:
            return
        callers = {listener.caller for listener in self._all() if listener.caller is not None}
        gone = await asyncio.to_thread(keys.no_longer_valid, self._database, callers)
        for listener in self._all():
            if listener.caller in gone:
                listener.close()
        self._keys_until = time.monotonic() + KEYS_S

    def _tell(self, job: str, row: sa.RowMapping | None, present: set[Listener]) -> None:
        """Offer a job as it is now, or that it is gone, to those of the listeners who were not told."""
        project, revision = self._seen.get(job, ("", 0)) if row is None else (row["project"], row["revision"])
        was_told = job not in self._seen if row is None else self._seen.get(job) == (project, revision)
        listeners = (self._listeners.get(job, set()) | self._listeners.get(project, set())) & present
        if was_told:
            listeners = {listener for listener in listeners if listener.fresh}
        if listeners:
            change = Change(job, revision, True, None) if row is None else Change(
                job, revision, row["state"] in ENDED, JobView.of(row).model_dump_json(by_alias=True))
            for listener in listeners:
                listener.offer(change)

    def _all(self) -> list[Listener]:
        return [listener for listeners in self._listeners.values() for listener in listeners]
