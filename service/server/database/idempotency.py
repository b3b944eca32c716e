"""Idempotency tokens: a request that is sent again with the same token creates nothing again."""

import hashlib
import json
import time
from collections.abc import Callable
from typing import Any

import sqlalchemy as sa
from sqlalchemy.exc import IntegrityError

from service.errors import RequestError
from service.server.database.engine import Database
from service.server.database.tables import idempotency


class TokenReused(RequestError):
    """The token was sent with another request before; the message says so."""


def create_once(database: Database, project: str, token: str | None, asked: Any, make: Callable[[sa.Connection], str]) -> str:
    """Create something once for a token of the client, or, with None, at every request; return its identifier.

    `asked` has all values of the request, as JSON can hold them; `make` creates in the transaction, and returns the identifier.
    """
    if token is None:
        return database.transact(make)
    fingerprint = _fingerprint(asked)

    def work(connection: sa.Connection) -> str:
        row = connection.execute(sa.select(idempotency).where(*_is(project, token))).mappings().one_or_none()
        if row is not None:
            return _same(row, fingerprint)
        connection.execute(idempotency.insert().values(project=project, token=token, fingerprint=fingerprint, made="",
                                                       created_at=time.time()))  # the same request at the same time waits here
        created = make(connection)
        connection.execute(idempotency.update().where(*_is(project, token)).values(made=created))
        return created

    try:
        return database.transact(work)
    except IntegrityError:  # the same request at the same time has created it, or the error is another one
        return database.transact(work)


def created_by(database: Database, project: str, token: str | None, asked: Any) -> str | None:
    """Return what was created with a token, as `create_once` does; None: nothing."""
    row = None if token is None else database.row(sa.select(idempotency).where(*_is(project, token)))
    return None if row is None else _same(row, _fingerprint(asked))


def forget_token(connection: sa.Connection, project: str, token: str, gone: str) -> None:
    """Forget a token whose creation was deleted, so that it can create another, unless it has already."""
    connection.execute(idempotency.delete().where(*_is(project, token), idempotency.c.made == gone))


def drop_before(database: Database, when: float) -> None:
    """Forget the tokens of requests before a time."""
    database.execute(idempotency.delete().where(idempotency.c.created_at < when))


def _is(project: str, token: str) -> "tuple[sa.ColumnElement[bool], ...]":
    return idempotency.c.project == project, idempotency.c.token == token


def _fingerprint(asked: Any) -> str:
    return hashlib.sha256(json.dumps(asked, sort_keys=True).encode()).hexdigest()


def _same(row: sa.RowMapping, fingerprint: str) -> str:
    if row["fingerprint"] != fingerprint:
        raise TokenReused(f"Idempotency-Key {row['token']}: came with another request before: choose a new one")
    return str(row["made"])
