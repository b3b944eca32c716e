"""Hooks of projects, and the deliveries to them.

A delivery is written in the transaction that ends its job, so that neither exists without the other. A sender (service.server.process)
takes a delivery by setting the time of its next try, which no other sender passes: one that is killed meanwhile is replaced then.
"""

import base64
import secrets
import time
from typing import Any

import sqlalchemy as sa

from service.requests.base.identifiers import DELIVERY, HOOK, new_id
from service.requests.hooks import HookEvent, NewHook
from service.requests.states import CANCELLED, FAILED, SUCCEEDED
from service.server.database.engine import Database
from service.server.database.tables import deliveries, hooks, jobs

EVENTS = {SUCCEEDED: HookEvent.FINISHED, FAILED: HookEvent.FAILED, CANCELLED: HookEvent.CANCELLED}
TEST = "test"
"""The event of a delivery that a user asked for, to see that the receiver answers."""
WAITING, DELIVERED, GIVEN_UP = "waiting", "delivered", "given_up"
SECRET_BYTES = 32
LEASE_S = 30.0
"""Seconds after which a delivery that a sender took is tried by another: a try takes a third of it."""
VIEWED = ("id", "state", "attempt", "revision", "priority", "request", "created_at", "started_at", "finished_at", "error", "stage", "done",
          "total", "rate")
"""The columns of a job that its view is made of."""


def insert(connection: sa.Connection, project: str, wanted: NewHook) -> sa.RowMapping:
    """Insert a hook with a new secret, in the form of Standard Webhooks, and return it."""
    secret = "whsec_" + base64.b64encode(secrets.token_bytes(SECRET_BYTES)).decode()
    return connection.execute(hooks.insert().values(
        id=new_id(HOOK), project=project, url=wanted.url, events=[str(event) for event in wanted.events], secret=secret,
        created_at=time.time()).returning(hooks)).mappings().one()


def listing(database: Database, project: str, hook: str | None = None) -> list[sa.RowMapping]:
    """Return the hooks of a project, or one of them, the oldest first."""
    query = sa.select(hooks).where(hooks.c.project == project).order_by(hooks.c.created_at, hooks.c.id)
    return database.rows(query if hook is None else query.where(hooks.c.id == hook))


def remove(connection: sa.Connection, project: str, hook: str) -> bool:
    """Delete a hook with its deliveries; return False if the project has no such hook."""
    return connection.execute(hooks.delete().where(hooks.c.id == hook, hooks.c.project == project)).rowcount == 1


def record_end(connection: sa.Connection, job: str) -> None:
    """Write the deliveries for a job that has ended in the caller's transaction, with the job as it is now; none for a check."""
    row = connection.execute(sa.select(jobs).where(jobs.c.id == job)).mappings().one()
    if row["request"]["kind"] == "check":
        return
    event, job_now = EVENTS[row["state"]], {name: row[name] for name in VIEWED}
    wanted = sa.select(hooks.c.id, hooks.c.events).where(hooks.c.project == row["project"])
    for hook in connection.execute(wanted.with_for_update(read=True, key_share=True)).all():  # it is not deleted meanwhile
        if event in hook.events:
            _insert_delivery(connection, hook.id, event, job, job_now)


def record_test(connection: sa.Connection, hook: str) -> sa.RowMapping:
    """Write a delivery that tells of no job, and return it."""
    return _insert_delivery(connection, hook, TEST, None, None)


def _insert_delivery(connection: sa.Connection, hook: str, event: str, job: str | None, snapshot: dict[str, Any] | None) -> sa.RowMapping:
    now = time.time()
    return connection.execute(deliveries.insert().values(
        id=new_id(DELIVERY), hook=hook, event=str(event), job=job, snapshot=snapshot, state=WAITING, tries=0, made_at=now,
        due_at=now).returning(deliveries)).mappings().one()


def due(database: Database, now: float) -> list[sa.RowMapping]:
    """Return for each hook the delivery that is due for longest (id, hook, project), the longest first."""
    place = sa.func.row_number().over(partition_by=deliveries.c.hook, order_by=(deliveries.c.due_at, deliveries.c.id))
    ranked = sa.select(deliveries.c.id, deliveries.c.hook, deliveries.c.due_at, place.label("place")).where(
        deliveries.c.due_at <= now).subquery()
    return database.rows(sa.select(ranked.c.id, ranked.c.hook, hooks.c.project).join(hooks, hooks.c.id == ranked.c.hook).where(
        ranked.c.place == 1).order_by(ranked.c.due_at))


def take(connection: sa.Connection, delivery: str, now: float) -> sa.RowMapping | None:
    """Count a try of a delivery that is due and return it with its hook; None: another sender was faster, or the hook was deleted."""
    taken = connection.execute(deliveries.update().where(deliveries.c.id == delivery, deliveries.c.due_at <= now).values(
        due_at=now + LEASE_S, tried_at=now, tries=deliveries.c.tries + 1))
    if taken.rowcount != 1:
        return None
    query = sa.select(deliveries, hooks.c.url, hooks.c.secret).join(hooks, hooks.c.id == deliveries.c.hook)
    return connection.execute(query.where(deliveries.c.id == delivery)).mappings().one()


def settle(connection: sa.Connection, taken: sa.RowMapping, *, state: str, answer: str, due_at: float | None) -> bool:
    """Record what came of a try; return False if another sender has taken the delivery meanwhile, or the hook was deleted."""
    return connection.execute(deliveries.update().where(
        deliveries.c.id == taken["id"], deliveries.c.tries == taken["tries"], deliveries.c.state == WAITING).values(
        state=state, answer=answer, due_at=due_at)).rowcount == 1


def last_delivery(database: Database, hook: str) -> sa.RowMapping | None:
    """Return the delivery to a hook that was tried last, or was made last where none was tried yet."""
    return database.row(sa.select(deliveries).where(deliveries.c.hook == hook).order_by(
        sa.func.coalesce(deliveries.c.tried_at, 0.0).desc(), deliveries.c.made_at.desc()))


def count_waiting(database: Database, hook: str) -> int:
    """Return how many deliveries to a hook are to be tried again, or for the first time."""
    row = database.row(sa.select(sa.func.count().label("count")).where(deliveries.c.hook == hook, deliveries.c.state == WAITING))
    return 0 if row is None else int(row["count"])


def drop_before(connection: sa.Connection, when: float) -> int:
    """Delete the deliveries from before a time that are delivered or given up, and return how many went."""
    return connection.execute(deliveries.delete().where(deliveries.c.due_at.is_(None), deliveries.c.made_at < when)).rowcount
