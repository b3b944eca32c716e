"""Hooks of projects, and the deliveries to them.

A delivery is written in the transaction that ends its job, so that neither exists without the other. A sender (service.server.process)
takes a hook for one try by setting the time of its next one: where a sender is killed meanwhile, another takes the hook then. The same
time is the pause of a hook whose receiver refused: however many deliveries wait, they share one schedule.
"""

import base64
import json
import secrets
import time
from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Any

import sqlalchemy as sa

from service.requests.answers import JobView
from service.requests.base.identifiers import DELIVERY, HOOK, new_id
from service.requests.hooks import HookEvent, NewHook
from service.requests.states import CANCELLED, FAILED, SUCCEEDED
from service.server.database.engine import Database, begin_writing
from service.server.database.tables import deliveries, hooks, jobs

EVENTS = {SUCCEEDED: HookEvent.FINISHED, FAILED: HookEvent.FAILED, CANCELLED: HookEvent.CANCELLED}
TEST = "test"
"""The event of a delivery that a user asked for, to see that the receiver answers."""
WAITING, DELIVERED, GIVEN_UP = "waiting", "delivered", "given_up"
SECRET_BYTES = 32
MOST_WAITING = 1000
"""Deliveries that wait for one hook at most; beyond them the oldest are given up."""


def insert(connection: sa.Connection, project: str, wanted: NewHook) -> sa.RowMapping:
    """Insert a hook with a new secret, in the form of Standard Webhooks, and return it."""
    secret = "whsec_" + base64.b64encode(secrets.token_bytes(SECRET_BYTES)).decode()
    return connection.execute(hooks.insert().values(
        id=new_id(HOOK), project=project, url=wanted.url, events=[str(event) for event in wanted.events], secret=secret,
        created_at=(now := time.time()), due_at=now, failures=0).returning(hooks)).mappings().one()


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
    event, now, body = EVENTS[row["state"]], time.time(), None
    wanted = sa.select(hooks.c.id, hooks.c.events).where(hooks.c.project == row["project"])
    for hook in connection.execute(wanted.with_for_update(read=True, key_share=True)).all():  # it is not deleted meanwhile
        if event in hook.events:
            body = body or _body(f"job.{event}", now, JobView.of(row).model_dump(mode="json"))
            _insert_delivery(connection, hook.id, event, job, now, body)


def record_test(connection: sa.Connection, project: str, hook: str) -> sa.RowMapping | None:
    """Write a delivery that tells of no job, end the pause of its hook, and return it; None: the project has no such hook."""
    now = time.time()
    if connection.execute(hooks.update().where(hooks.c.id == hook, hooks.c.project == project).values(due_at=now)).rowcount != 1:
        return None
    return _insert_delivery(connection, hook, TEST, None, now, _body("hook.test", now, {"hook": hook}))


def _body(kind: str, now: float, data: dict[str, Any]) -> str:
    """Return the body of a delivery, which is the same in each try and after an upgrade."""
    at = datetime.fromtimestamp(now, UTC).isoformat().replace("+00:00", "Z")
    return json.dumps({"type": kind, "timestamp": at, "data": data}, separators=(",", ":"))


def _insert_delivery(connection: sa.Connection, hook: str, event: str, job: str | None, now: float, body: str) -> sa.RowMapping:
    return connection.execute(deliveries.insert().values(
        id=new_id(DELIVERY), hook=hook, event=str(event), job=job, body=body, state=WAITING, tries=0, made_at=now).returning(
        deliveries)).mappings().one()


def due(database: Database, now: float) -> list[sa.RowMapping]:
    """Return the hooks (id, project) that have a delivery and no pause, those first that have been free for longest."""
    waits = sa.exists().where(deliveries.c.hook == hooks.c.id, deliveries.c.state == WAITING)
    return database.rows(sa.select(hooks.c.id, hooks.c.project).where(hooks.c.due_at <= now, waits).order_by(hooks.c.due_at, hooks.c.id))


def take(connection: sa.Connection, hook: str, *, now: float, until: float) -> sa.RowMapping | None:
    """Count a try of the next delivery to a hook that is due, and return it with its hook, which no other sender takes before `until`.

    The delivery is the oldest of those that were tried least, a test before others. None: another sender was faster, or the hook is gone.
    """
    begin_writing(connection)
    free = sa.select(hooks.c.id).where(hooks.c.id == hook, hooks.c.due_at <= now).with_for_update(key_share=True)
    if connection.execute(free).first() is None:
        return None
    chosen = sa.select(deliveries.c.id).where(deliveries.c.hook == hook, deliveries.c.state == WAITING).order_by(
        deliveries.c.tries, deliveries.c.job.is_not(None), deliveries.c.made_at, deliveries.c.id).limit(1).scalar_subquery()
    delivery = connection.execute(deliveries.update().where(deliveries.c.id == chosen).values(
        tried_at=now, tries=deliveries.c.tries + 1).returning(deliveries.c.id)).scalar()
    if delivery is None:
        return None
    connection.execute(hooks.update().where(hooks.c.id == hook).values(due_at=until))
    query = sa.select(deliveries, hooks.c.url, hooks.c.secret, hooks.c.failures).join(hooks, hooks.c.id == deliveries.c.hook)
    return connection.execute(query.where(deliveries.c.id == delivery)).mappings().one()


def settle(connection: sa.Connection, taken: sa.RowMapping, *, state: str, answer: str, due_at: float) -> bool:
    """Record what came of a try, and when the hook may be tried again; return False if another sender took the delivery, or it is gone."""
    mine = (deliveries.c.id == taken["id"], deliveries.c.tries == taken["tries"], deliveries.c.state == WAITING)
    failures = 0 if state == DELIVERED else taken["failures"] + 1
    connection.execute(hooks.update().where(hooks.c.id == taken["hook"], sa.exists().where(*mine)).values(due_at=due_at, failures=failures))
    return connection.execute(deliveries.update().where(*mine).values(
        state=state, answer=answer, **({} if state == WAITING else {"body": None}))).rowcount == 1


def give_up(connection: sa.Connection, before: float) -> Sequence[sa.RowMapping]:
    """Give up the deliveries from before a time, and those beyond the newest MOST_WAITING of a hook, and return them."""
    place = sa.func.row_number().over(partition_by=deliveries.c.hook, order_by=(deliveries.c.made_at.desc(), deliveries.c.id))
    waiting = sa.select(deliveries.c.id, deliveries.c.made_at, place.label("place")).where(deliveries.c.state == WAITING).subquery()
    late = sa.select(waiting.c.id).where((waiting.c.made_at < before) | (waiting.c.place > MOST_WAITING))
    return connection.execute(deliveries.update().where(deliveries.c.id.in_(late), deliveries.c.state == WAITING).values(
        state=GIVEN_UP, body=None, answer=sa.func.coalesce(deliveries.c.answer, "not tried")).returning(deliveries)).mappings().all()


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
    return connection.execute(deliveries.delete().where(deliveries.c.state != WAITING, deliveries.c.made_at < when)).rowcount
