"""The event streams that are open, so that their limits hold across API processes.

Each process writes how many streams each key has open with it, for LEASE_S seconds: when a stream is opened, which the same transaction
allows or refuses, and every few seconds while streams are open. The numbers of a process that has died expire by themselves.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import sqlalchemy as sa

from service.server.database import exclusive
from service.server.database.engine import Database
from service.server.database.tables import streams

LEASE_S = 20.0
"""Seconds for which the numbers of a process count after it has written them."""


class Holder(NamedTuple):
    """Who opens streams."""

    project: str
    key: str
    """Identifier of the key or of the user of an identity provider; empty: the request has neither."""


class Limits(NamedTuple):
    """The most streams that may be open."""

    of_project: int
    of_key: int

    def refusal(self, holder: Holder, counts: Mapping[Holder, int]) -> str | None:
        """Return why a holder may open no further stream, as a sentence; None: it may."""
        if counts.get(holder, 0) >= self.of_key:
            return f"this key has {self.of_key} streams of events, and no more may be open"
        if sum(count for other, count in counts.items() if other.project == holder.project) >= self.of_project:
            return f"this project has {self.of_project} streams of events, and no more may be open"
        return None


def record(database: Database, process: str, held: Mapping[Holder, int], asked: Sequence[Holder], limits: Limits) -> list[str | None]:
    """Write what a process has open, with those of the streams that are asked for that may be opened, and delete what has expired.

    Args:
        database: of the service.
        process: identifier of the API process.
        held: number of streams that each holder has open with it.
        asked: who asks for a stream, once for each.
        limits: of streams over all processes.

    Returns:
        For each stream that is asked for, why it may not be opened, as a sentence; None: it may.

    Raises:
        DBAPIError: the database does not answer.
    """
    return database.transact(lambda connection: _record(connection, process, held, asked, limits))


def _record(connection: sa.Connection, process: str, held: Mapping[Holder, int], asked: Sequence[Holder],
            limits: Limits) -> list[str | None]:
    exclusive.lock(connection, exclusive.STREAMS)
    now = exclusive.now(connection)
    # a time far ahead is of a clock that was set
    connection.execute(streams.delete().where(
        (streams.c.process == process) | (streams.c.until < now) | (streams.c.until > now + 2 * LEASE_S)))
    mine, answers = Counter(held), list[str | None]()
    if asked:
        everywhere = Counter(held)
        for row in connection.execute(sa.select(streams).where(streams.c.project.in_({holder.project for holder in asked}))):
            everywhere[Holder(row.project, row.key)] += row.open
        for holder in asked:
            answers.append(limits.refusal(holder, everywhere))
            if answers[-1] is None:
                everywhere[holder] += 1
                mine[holder] += 1
    rows = [{"process": process, "project": holder.project, "key": holder.key, "open": count, "until": now + LEASE_S}
            for holder, count in mine.items() if count]
    if rows:
        connection.execute(streams.insert(), rows)
    return answers
