"""How often each key may ask, so that the limit holds across API processes.

Each key has a bucket of tokens in the database, of which a request takes one. An API process takes several at a time, as a lease: those
that requests wait for, and an eighth of what is left, so that several processes have some, and none asks the database for each request.
The bucket gains no more tokens than it and all leases together may hold, which is a burst. A process gives back what it has not used with
its next lease; a lease of a process that has died expires.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import sqlalchemy as sa

from service.server.database import exclusive
from service.server.database.engine import Database
from service.server.database.tables import rates

LEASE_S = 10.0
"""Seconds for which the tokens of a lease may be used."""
SHARE = 8
"""The part of the tokens that one lease takes beside those that requests wait for."""


class Rate(NamedTuple):
    """The limit of every key."""

    per_second: float
    """Tokens that a bucket gains."""
    burst: int
    """Tokens that it holds."""


class Wanted(NamedTuple):
    """What a process asks for one key."""

    key: str
    """Identifier of the key or of the user of an identity provider; empty: the request has neither."""
    waiting: int
    """Requests that wait, at least 1."""
    unused: int
    """Tokens of the last lease that were not used."""


class Leased(NamedTuple):
    """What a process gets."""

    tokens: int
    """Those that requests wait for first; fewer than wait if the bucket is empty."""
    wait_s: float
    """Seconds until the bucket has one token; 0: it has."""


def lease(database: Database, process: str, wanted: Sequence[Wanted], rate: Rate) -> list[Leased]:
    """Take tokens from the buckets of several keys, in one transaction.

    Args:
        database: of the service.
        process: identifier of the API process.
        wanted: one for each key.
        rate: limit of each key.

    Returns:
        What the process gets for each key.

    Raises:
        DBAPIError: the database does not answer.
    """
    return database.transact(lambda connection: _lease(connection, process, wanted, rate))


def _lease(connection: sa.Connection, process: str, wanted: Sequence[Wanted], rate: Rate) -> list[Leased]:
    exclusive.lock(connection, exclusive.RATES)
    now = exclusive.now(connection)
    connection.execute(rates.delete().where(rates.c.full_at < now))  # a bucket that is full is like a new one
    known = {row["key"]: row for row in connection.execute(
        sa.select(rates).where(rates.c.key.in_([each.key for each in wanted]))).mappings()}
    given = []
    for each in wanted:
        row = known.get(each.key)
        leased, values = _from_bucket(row, process, each, rate, now)
        given.append(leased)
        connection.execute(rates.insert().values(key=each.key, **values) if row is None
                           else rates.update().where(rates.c.key == each.key).values(**values))
    return given


def _from_bucket(row: sa.RowMapping | None, process: str, wanted: Wanted, rate: Rate, now: float) -> tuple[Leased, dict[str, Any]]:
    """Return what the process gets, and the bucket afterwards."""
    leases: dict[str, list[float]] = {} if row is None else {
        name: [tokens, until] for name, (tokens, until) in row["leases"].items()
        if name != process and now < until < now + 2 * LEASE_S}  # a time far ahead is of a clock that was set
    room = rate.burst - sum(tokens for tokens, _ in leases.values())
    level = room if row is None else min(room, row["tokens"] + wanted.unused + max(0.0, now - row["counted_at"]) * rate.per_second)
    asked = min(int(level), wanted.waiting)
    ahead = int(level - asked) // SHARE if asked == wanted.waiting else 0
    level -= asked + ahead
    if ahead:
        leases[process] = [ahead, now + LEASE_S]
    full_at = max([now + (rate.burst - level) / rate.per_second, *(until for _, until in leases.values())])
    return (Leased(asked + ahead, max(0.0, (1 - level) / rate.per_second)),
            {"tokens": level, "counted_at": now, "leases": leases, "full_at": full_at})
