"""Housekeeping: the service deletes old jobs, abandoned uploads, and what workers and captures that are gone have left.

Captures, environments and jobs that have not ended are never deleted.
"""

import shutil
import time
import traceback
from collections.abc import Callable
from functools import partial
from pathlib import Path

import sqlalchemy as sa

from service.server.base.log import logger
from service.server.base.rounds import Rounds
from service.server.base.settings import Settings
from service.server.database import audit, hooks, idempotency, intakes, jobs, workers
from service.server.database.engine import UNANSWERED, Database, message_of
from service.server.database.tables import clock as clock_table
from service.server.jobs.queue import JobQueue
from service.server.jobs.takeover import FileWorkerLock
from service.server.storage import layout
from service.server.storage.folder import drop_folder
from service.server.storage.objects import Storage
from service.server.storage.upload_parts import open_upload_parts
from stage.errors import StorageError

EVERY_S = 600.0
HOUR_S, DAY_S = 3600.0, 86_400.0
TOKEN_S = DAY_S
"""Seconds for which an idempotency token is remembered."""
GIVE_UP_S = 2 * DAY_S
"""Seconds after which a delivery to a hook is given up, however often it was tried."""
DELIVERY_S = 30 * DAY_S
"""Seconds for which a delivery to a hook is kept that was accepted or given up."""
UNFINISHED_S = DAY_S
"""Seconds without a write after which an unfinished image stack is deleted."""
FORGET_S = HOUR_S
"""Seconds after which a worker that has not been seen is forgotten. Two rounds in a row must find it so: after the database was unreachable
for as long, its workers are seen again between the two rounds."""
WAIT_S = 86_400.0
"""Seconds after a jump for which nothing is removed for its age: an operator reads the log and sets the clock meanwhile."""
STEP_S = 3600.0
"""Seconds by which a clock may be set forth or back without being a jump."""
DOWNTIME_S = 86_400.0
"""Seconds for which the service may be away without its clock being doubted: how long it was really away, nobody knows."""


class Housekeeper(Rounds):
    """A thread that does the housekeeping every EVERY_S."""

    def __init__(self, settings: Settings, database: Database, storage: Storage, queue: JobQueue, *,
                 clock: Callable[[], float] = time.time, monotonic: Callable[[], float] = time.monotonic) -> None:
        """Create the thread; `start` starts it. `clock` is in seconds since 1970, `monotonic` does not jump when the clock is set."""
        super().__init__("relit-housekeeping", EVERY_S, self.round)
        self._settings, self._database, self._storage, self._queue, self._clock = settings, database, storage, queue, clock
        self._watch = ClockWatch(database, now=clock, monotonic=monotonic)
        self._parts = open_upload_parts(settings, database, storage)
        self._silent: set[str] = set()
        self._told: dict[str, str] = {}  # the last error of each piece of work that fails, which is logged once

    def round(self) -> None:
        """Do all pieces of work once; a piece that fails is tried again in the next round."""
        for piece in (self._aged, self._workers, self._caches, self._leftovers, self._interrupted):
            if self._ended:
                return
            self._try(piece.__name__.strip("_"), piece)

    def _try(self, piece: str, work: Callable[[], object]) -> None:
        """Do a piece of work. Whatever error it meets, the thread goes on with the next; the same error is logged once."""
        try:
            work()
        except (*UNANSWERED, StorageError, OSError) as error:
            logger.warning("housekeeping waits", piece=piece, error=message_of(error))
        except Exception as error:  # of relit itself, or of a row that cannot be read
            if self._told.get(piece) != (told := message_of(error)):
                logger.error("housekeeping failed", piece=piece, error=told, trace=traceback.format_exc())
            self._told[piece] = told
        else:
            self._told.pop(piece, None)

    def _aged(self) -> None:
        """Remove what is old, unless the clock that says so has jumped."""
        if self._watch.steady():
            for piece in (self._jobs, self._uploads, self._tokens, self._deliveries, self._audit):
                self._try(piece.__name__.strip("_"), piece)

    def _jobs(self) -> None:
        if self._settings.retention_days is None:
            return
        for row in jobs.ended_before(self._database, self._clock() - self._settings.retention_days * DAY_S):
            if self._ended:
                return
            self._try(row["id"], partial(self._remove_job, row))

    def _remove_job(self, row: sa.RowMapping) -> None:
        with self._database.begin() as connection:
            removed = not jobs.users_of(connection, row["id"]) and jobs.remove(connection, row["id"])
        if removed:
            self._storage.remove(layout.results(row["project"], row["id"]))
            self._storage.remove(layout.shared(row["project"], row["id"]))
            self._queue.forget(row["id"])
            logger.info("job removed", job=row["id"], project=row["project"])

    def _uploads(self) -> None:
        if removed := self._parts.expire(self._clock() - self._settings.upload_hours * HOUR_S):
            logger.info("uploads removed", count=removed)

    def _tokens(self) -> None:
        idempotency.drop_before(self._database, self._clock() - TOKEN_S)

    def _deliveries(self) -> None:
        with self._database.begin() as connection:
            for row in hooks.give_up(connection, self._clock() - GIVE_UP_S):
                if row["job"] is not None:
                    jobs.note(connection, row["job"], f"{row['hook']} given up after {row['tries']} tries: {row['answer']}")
            hooks.drop_before(connection, self._clock() - DELIVERY_S)

    def _audit(self) -> None:
        now = self._clock()
        if removed := audit.prune(self._database, before=now - self._settings.audit_days * DAY_S, now=now):
            logger.info("lines of the audit log removed", count=removed)

    def _workers(self) -> None:
        silent = {row["id"] for row in workers.not_seen_since(self._database, self._clock() - FORGET_S)}
        for worker in silent & self._silent:
            workers.remove(self._database, worker)
            if self._database.is_sqlite:
                with FileWorkerLock(self._settings.locks, "").dead(worker):  # which deletes the lock file of a worker that is dead
                    pass
            logger.info("worker forgotten", worker=worker)
        self._silent = silent - self._silent

    def _caches(self) -> None:
        folder = self._settings.cache
        if not folder.is_dir():
            return
        there = {path.name: path for path in folder.iterdir() if path.is_dir()}
        kept = intakes.last_used(self._database, list(there))
        for name in there.keys() - kept.keys():  # of captures that were deleted
            _clear(there[name])
        if self._settings.cache_bytes is None:
            return
        sizes = {name: sum(file.stat().st_size for file in there[name].rglob("*") if file.is_file()) for name in kept}
        total = sum(sizes.values())
        for name in sorted(kept, key=lambda name: kept[name]):
            if total <= self._settings.cache_bytes:
                return
            self._try(name, partial(self._clear_unread, there[name]))
            total -= 0 if there[name].exists() else sizes[name]

    def _clear_unread(self, cache: Path) -> None:
        with self._database.begin() as connection:
            in_use = jobs.users_of(connection, cache.name)
        if not in_use:
            _clear(cache)

    def _leftovers(self) -> None:
        """Delete what a writer that was under way has made again of a prefix that was removed with its row."""
        for prefix in self._storage.leftovers():
            identifier = prefix.rpartition("/")[2]
            if jobs.find(self._database, identifier) is None and not intakes.last_used(self._database, [identifier]):
                self._storage.remove(prefix)
                logger.info("leftover removed", prefix=prefix)

    def _interrupted(self) -> None:
        """Finish deletions, and delete unfinished files, that a power failure or a kill interrupted."""
        self._storage.tidy()
        for path in self._settings.cache.rglob(".*"):  # of a worker that was killed while it wrote a stack
            if path.is_file() and path.stat().st_mtime < self._clock() - UNFINISHED_S:
                path.unlink(missing_ok=True)
                logger.info("unfinished stack removed", file=path.name)


def _clear(folder: Path) -> None:
    """Delete a stack cache; it is hidden first, so that no job finds a part of it."""
    if folder.name.startswith("."):  # it is hidden already
        shutil.rmtree(folder, ignore_errors=True)
    else:
        drop_folder(folder)
    logger.info("stack cache removed", capture=folder.name)


class ClockWatch:
    """Looks at the clock now and then, and tells whether ages by it count.

    A clock that jumps years ahead would make every job old at once. So the time at each look is recorded, and compared at the next look
    with the time that has really passed; after a jump, ages count again only when the clock has gone on steadily for WAIT_S.
    """

    def __init__(self, database: Database, *, now: Callable[[], float], monotonic: Callable[[], float]) -> None:
        self._database, self._now, self._monotonic = database, now, monotonic
        self._looked: float | None = None

    def steady(self) -> bool:
        """Record the time, and return whether the clock has gone on without a jump for WAIT_S."""
        now, monotonic = self._now(), self._monotonic()
        row = self._database.row(sa.select(clock_table))
        passed = 0.0 if self._looked is None else monotonic - self._looked
        waits_s = 0.0 if row is None else max(0.0, row["waits_s"] - passed)
        if row is not None:
            jump = now - row["seen_at"] - passed
            if not -STEP_S <= jump <= (DOWNTIME_S if self._looked is None else STEP_S):
                logger.error("the clock jumped: for a day nothing is removed for its age", jump_s=round(jump))
                waits_s = WAIT_S
        if self._database.execute(clock_table.update().values(seen_at=now, waits_s=waits_s)) == 0:
            self._database.execute(clock_table.insert().values(id=1, seen_at=now, waits_s=waits_s))
        self._looked = monotonic
        return waits_s == 0.0
