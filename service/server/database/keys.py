"""API keys. Only a hash of their secret is kept."""

import hashlib
import hmac
import secrets
import time
from collections.abc import Collection
from datetime import UTC, datetime
from typing import NamedTuple

import sqlalchemy as sa

from service.requests.base.identifiers import KEY, new_id
from service.requests.keys import NewKey, Scope
from service.server.database.engine import Database
from service.server.database.tables import keys

SECRET_BYTES = 32
"""256 random bits cannot be found by trying, so that one round of SHA-256 is enough."""
DEFAULT_PROJECT = "default"
"""The project of whoever needs no key: requests from the machine of an anonymous service, and the sample of `relit demo --serve`."""
ORDER = list(Scope)
DAY_S = 86_400.0
USED_S = 60.0
"""Seconds to which the last use of a key is recorded, so that not every request writes."""


class Caller(NamedTuple):
    """The sender of a request."""

    project: str
    scope: Scope
    key: str | None
    """Identifier of the key, or of the user of an identity provider; None: the request has neither."""
    until: float | None = None
    """Time at which the key or the token expires, seconds since 1970; None: never."""

    def may(self, scope: Scope) -> bool:
        """Return whether the caller's scope includes this one."""
        return ORDER.index(self.scope) >= ORDER.index(scope)


def insert(connection: sa.Connection, wanted: NewKey) -> str:
    """Create a key, and return it as its user sends it; it cannot be shown again."""
    identifier, secret, now = new_id(KEY), secrets.token_urlsafe(SECRET_BYTES), time.time()
    connection.execute(keys.insert().values(
        id=identifier, project=wanted.project, name=wanted.name, scope=wanted.scope, digest=_digest(secret), created_at=now,
        expires_at=None if wanted.expires_days is None else now + wanted.expires_days * DAY_S))
    return f"{identifier}.{secret}"


def find(database: Database, presented: str) -> Caller | str:
    """Return the caller to whom a key belongs, or why it is refused; who does not have its secret is told nothing of it.

    A use of the key is recorded.
    """
    identifier, _, secret = presented.partition(".")
    row, now = database.row(sa.select(keys).where(keys.c.id == identifier)), time.time()
    if row is None or not hmac.compare_digest(row["digest"], _digest(secret)):
        return "this service does not know the key"
    if row["revoked_at"] is not None:
        return f"the key was revoked on {_day(row['revoked_at'])}"
    if row["expires_at"] is not None and row["expires_at"] <= now:
        return f"the key expired on {_day(row['expires_at'])}"
    if row["used_at"] is None or abs(now - row["used_at"]) > USED_S:
        database.execute(keys.update().where(keys.c.id == identifier).values(used_at=now))
    return Caller(row["project"], Scope(row["scope"]), identifier, row["expires_at"])


def no_longer_valid(database: Database, callers: Collection[Caller]) -> set[Caller]:
    """Return those of the callers whose key or token was revoked or has expired."""
    now, used = time.time(), {caller.key for caller in callers if (caller.key or "").startswith(f"{KEY}_")}
    unexpired = keys.c.expires_at.is_(None) | (keys.c.expires_at > now)
    still = sa.select(keys.c.id).where(keys.c.id.in_(used), keys.c.revoked_at.is_(None), unexpired)
    valid = {row["id"] for row in database.rows(still)} if used else set()
    return {caller for caller in callers if caller.key in used - valid or (caller.until is not None and caller.until < now)}


def revoke(connection: sa.Connection, identifier: str) -> str | None:
    """Revoke a key; return its project, or None if there is no such key or it was revoked before."""
    return connection.execute(keys.update().where(keys.c.id == identifier, keys.c.revoked_at.is_(None)).values(
        revoked_at=time.time()).returning(keys.c.project)).scalar()


def listing(database: Database, project: str | None = None) -> list[sa.RowMapping]:
    """Return the keys of a project or of all, without their secrets, the oldest first."""
    query = sa.select(keys.c.id, keys.c.project, keys.c.name, keys.c.scope, keys.c.created_at, keys.c.revoked_at,
                      keys.c.expires_at, keys.c.used_at)
    return database.rows((query if project is None else query.where(keys.c.project == project)).order_by(keys.c.created_at))


def _digest(secret: str) -> str:
    return hashlib.sha256(secret.encode()).hexdigest()


def _day(when: float) -> str:
    return datetime.fromtimestamp(when, UTC).date().isoformat()
