"""A request that creates something, sent again with the same token, creates nothing again."""

import hashlib
import json
import time
from collections.abc import Callable
from typing import Any

import sqlalchemy as sa
from sqlalchemy.exc import IntegrityError

from service.store.database import Database
from service.store.tables import idempotency


class TokenReused(Exception):
    """The token came with another request before."""


def once(database: Database, project: str, token: str | None, asked: Any, make: Callable[[sa.Connection], str]) -> tuple[str, bool]:
    """Create something, once for a token.

    Args:
        database: where.
        project: whose.
        token: that the client chose; None: every request creates.
        asked: all that the request says, as JSON can hold it.
        make: creates it in the transaction, and returns its identifier.

    Returns:
        The identifier, and whether it was created now.

    Raises:
        TokenReused: the token belongs to another request.
    """
    if token is None:
        return database.transact(make), True
    fingerprint = hashlib.sha256(json.dumps(asked, sort_keys=True).encode()).hexdigest()
    before = sa.select(idempotency).where(idempotency.c.project == project, idempotency.c.token == token)

    def work(connection: sa.Connection) -> tuple[str, bool]:
        row = connection.execute(before).mappings().one_or_none()
        if row is not None:
            if row["fingerprint"] != fingerprint:
                raise TokenReused
            return row["made"], False
        made = make(connection)
        connection.execute(idempotency.insert().values(project=project, token=token, fingerprint=fingerprint, made=made,
                                                       created_at=time.time()))
        return made, True

    try:
        return database.transact(work)
    except IntegrityError:  # the same request, at the same time: it is there now, or the error is another's
        return database.transact(work)


def drop_before(connection: sa.Connection, when: float) -> None:
    """Forget tokens of requests before a time."""
    connection.execute(idempotency.delete().where(idempotency.c.created_at < when))
