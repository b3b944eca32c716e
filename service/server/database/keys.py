"""API keys. Only a hash of their secret is kept."""

import hashlib
import hmac
import secrets
import time
from collections.abc import Collection
from typing import NamedTuple

import sqlalchemy as sa

from service.requests.identifiers import KEY, new_id
from service.requests.keys import NewKey, Scope
from service.server.database.engine import Database
from service.server.database.tables import keys

SECRET_BYTES = 32
"""256 random bits cannot be found by trying, so that one round of SHA-256 is enough."""
DEFAULT_PROJECT = "default"
"""The project of whoever needs no key: requests from the machine of an anonymous service, and the sample of `relit demo --serve`."""
ORDER = list(Scope)


class Caller(NamedTuple):
    """Who sends a request."""

    project: str
    scope: Scope
    key: str | None
    """Identifier of the key; None: the request has no key."""

    def may(self, scope: Scope) -> bool:
        """Return whether the caller's scope includes this one."""
        return ORDER.index(self.scope) >= ORDER.index(scope)


def create(database: Database, wanted: NewKey) -> str:
    """Create a key.

    Returns:
        The key as its user sends it; it cannot be shown again.
    """
    identifier, secret = new_id(KEY), secrets.token_urlsafe(SECRET_BYTES)
    database.transact(lambda connection: connection.execute(keys.insert().values(
        id=identifier, **wanted.model_dump(), digest=_digest(secret), created_at=time.time())))
    return f"{identifier}.{secret}"


def find(database: Database, presented: str) -> Caller | None:
    """Return the caller to whom a key belongs; None: the key is unknown or was revoked."""
    identifier, _, secret = presented.partition(".")
    row = database.row(sa.select(keys).where(keys.c.id == identifier, keys.c.revoked_at.is_(None)))
    if row is None or not hmac.compare_digest(row["digest"], _digest(secret)):
        return None
    return Caller(row["project"], Scope(row["scope"]), identifier)


def still_valid(database: Database, identifiers: Collection[str]) -> set[str]:
    """Return those of the keys that have not been revoked."""
    return {row["id"] for row in database.rows(sa.select(keys.c.id).where(keys.c.id.in_(identifiers), keys.c.revoked_at.is_(None)))}


def revoke(database: Database, identifier: str) -> bool:
    """Revoke a key; return False if there is no such key or it was revoked before."""
    return database.transact(lambda connection: connection.execute(keys.update().where(
        keys.c.id == identifier, keys.c.revoked_at.is_(None)).values(revoked_at=time.time())).rowcount == 1)


def listing(database: Database, project: str | None = None) -> list[sa.RowMapping]:
    """Return the keys of a project or of all, without their secrets, the oldest first."""
    query = sa.select(keys.c.id, keys.c.project, keys.c.name, keys.c.scope, keys.c.created_at, keys.c.revoked_at)
    return database.rows((query if project is None else query.where(keys.c.project == project)).order_by(keys.c.created_at))


def _digest(secret: str) -> str:
    return hashlib.sha256(secret.encode()).hexdigest()
