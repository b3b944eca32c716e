"""The audit log: who did what to which object.

A line is written in the transaction of the change, so that neither exists without the other.

Triggers of the database refuse to change or delete a line. Who may change the schema of the database can still drop them.
"""

import getpass
import time

import sqlalchemy as sa
import structlog

from service.server.database.engine import Database
from service.server.database.keys import Caller
from service.server.database.tables import audit

ANONYMOUS = "anonymous"
REFUSAL = "the audit log is append-only"


def record(connection: sa.Connection, caller: Caller, action: str, target: str) -> None:
    """Write that a caller changed an object, in the transaction of the change.

    Args:
        connection: of the transaction.
        caller: who sent the request.
        action: such as `job.cancel`.
        target: identifier of the object.
    """
    request = structlog.contextvars.get_contextvars().get("request")
    _insert(connection, caller.project, caller.key or ANONYMOUS, action, target, request)


def record_operator(connection: sa.Connection, project: str, action: str, target: str) -> None:
    """Write that somebody changed an object by the command line on the server."""
    _insert(connection, project, f"operator {_user()}", action, target, None)


def listing(database: Database, *, project: str | None = None, limit: int) -> list[sa.RowMapping]:
    """Return the last lines of a project or of all, the newest first."""
    query = sa.select(audit) if project is None else sa.select(audit).where(audit.c.project == project)
    return database.rows(query.order_by(audit.c.id.desc()).limit(limit))


def protect(connection: sa.Connection) -> None:
    """Make the triggers that refuse to change or delete a line, if there are none."""
    if connection.dialect.name == "sqlite":
        for event in ("UPDATE", "DELETE"):
            connection.execute(sa.text(f"CREATE TRIGGER IF NOT EXISTS relit_audit_{event.lower()} BEFORE {event} ON relit_audit "
                                       f"BEGIN SELECT RAISE(ABORT, '{REFUSAL}'); END"))
    else:
        connection.execute(sa.text("CREATE OR REPLACE FUNCTION relit_audit_refuse() RETURNS trigger LANGUAGE plpgsql AS "
                                   f"$$ BEGIN RAISE EXCEPTION '{REFUSAL}'; END $$"))
        connection.execute(sa.text("CREATE OR REPLACE TRIGGER relit_audit_append_only BEFORE UPDATE OR DELETE OR TRUNCATE ON relit_audit "
                                   "FOR EACH STATEMENT EXECUTE FUNCTION relit_audit_refuse()"))


def _insert(connection: sa.Connection, project: str, actor: str, action: str, target: str, request: str | None) -> None:
    connection.execute(audit.insert().values(project=project, at=time.time(), actor=actor[:200], action=action, object=target,
                                             request=request))


def _user() -> str:
    try:
        return getpass.getuser()
    except (KeyError, OSError):  # a user without a name
        return "unknown"
