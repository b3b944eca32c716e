"""The audit log: who did what to which object.

A line is written in the transaction of the change, so that neither exists without the other. Triggers of the database refuse to change or
delete a line; who may change the schema of the database can drop them, as `prune` does for the length of its transaction.
"""

import getpass
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager

import sqlalchemy as sa
import structlog

from service.requests.keys import Scope
from service.server.database.engine import Database, begin_writing
from service.server.database.keys import DAY_S, Caller
from service.server.database.tables import audit

ANONYMOUS = "anonymous"
REFUSAL = "the audit log is append-only"
MOST_A_DAY = 10_000
"""Lines of a project and a day (UTC) that are kept one by one; those beyond become one line for each caller and action, with their
number."""
MORE = " more"
"""Ends the object of a line that stands for several, after their number."""
IS_SUM = audit.c.object.endswith(MORE)
TRIGGERS = {"sqlite": ("relit_audit_update", "relit_audit_delete"), "postgresql": ("relit_audit_append_only ON relit_audit",)}


def record(connection: sa.Connection, caller: Caller, action: str, target: str) -> None:
    """Write that a caller changed an object, in the transaction of the change; an action is such as `job.cancel`."""
    connection.execute(audit.insert().values(
        project=caller.project, at=time.time(), actor=(caller.key or ANONYMOUS)[:200], action=action, object=target,
        request=structlog.contextvars.get_contextvars().get("request")))


@contextmanager
def recorded(database: Database, caller: Caller, action: str, target: str) -> Iterator[sa.Connection]:
    """Begin a transaction for a change, and write at its end that the caller has made it; an exception undoes both."""
    with database.begin() as connection:
        yield connection
        record(connection, caller, action, target)


def record_operator(connection: sa.Connection, project: str, action: str, target: str) -> None:
    """Write that somebody changed an object by the command line on the server."""
    try:
        user = getpass.getuser()
    except (KeyError, OSError):  # a user without a name
        user = "unknown"
    record(connection, Caller(project, Scope.ADMIN, f"operator {user}"), action, target)


def listing(database: Database, *, project: str | None = None, limit: int, before: int | None = None) -> list[sa.RowMapping]:
    """Return the last lines of a project or of all, the newest first; `before` is the identifier of the last line of the page before."""
    query = sa.select(audit) if project is None else sa.select(audit).where(audit.c.project == project)
    if before is not None:
        query = query.where(audit.c.id < before)
    return database.rows(query.order_by(audit.c.id.desc()).limit(limit))


def prune(database: Database, *, before: float, now: float) -> int:
    """Delete the lines from before a time, and sum up those of today and yesterday beyond MOST_A_DAY; return how many lines went."""
    today = now // DAY_S * DAY_S
    crowded = [(row["project"], begin) for begin in (today - DAY_S, today) for row in database.rows(
        sa.select(audit.c.project).where(_of_day(begin), ~IS_SUM).group_by(audit.c.project).having(sa.func.count() > MOST_A_DAY))]
    if not crowded and database.row(sa.select(audit.c.id).where(audit.c.at < before)) is None:
        return 0
    with database.begin() as connection:
        begin_writing(connection)
        for trigger in TRIGGERS[connection.dialect.name]:
            connection.execute(sa.text(f"DROP TRIGGER {trigger}"))
        gone = connection.execute(audit.delete().where(audit.c.at < before)).rowcount
        gone += sum(_sum_up(connection, project, begin) for project, begin in crowded)
        protect(connection)
    return gone


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


def _of_day(begin: float) -> "sa.ColumnElement[bool]":
    return sa.and_(audit.c.at >= begin, audit.c.at < begin + DAY_S)


def _sum_up(connection: sa.Connection, project: str, begin: float) -> int:
    """Put one line for each caller and action in place of the lines of a day beyond MOST_A_DAY, and return how many went."""
    of_day = sa.and_(_of_day(begin), audit.c.project == project)
    kept = sa.select(audit.c.id).where(of_day, ~IS_SUM).order_by(audit.c.id).limit(MOST_A_DAY)
    beyond = sa.and_(of_day, audit.c.id.not_in(kept))
    counts: Counter[tuple[str, str]] = Counter()
    for row in connection.execute(sa.select(audit.c.actor, audit.c.action, audit.c.object).where(beyond)):
        counts[row.actor, row.action] += int(row.object.removesuffix(MORE)) if row.object.endswith(MORE) else 1
    last = connection.execute(sa.select(sa.func.max(audit.c.at)).where(beyond)).scalar()
    gone = connection.execute(audit.delete().where(beyond)).rowcount
    connection.execute(audit.insert(), [
        {"project": project, "at": last, "actor": actor, "action": action, "object": f"{count}{MORE}"}
        for (actor, action), count in counts.items()])
    return gone - len(counts)
