"""Writes the order of the queues into a table of DBOS, which no public call does; no other module knows a table of it.

DBOS 3.4 sets the priority of a workflow only when it is queued, a new attempt would lose the place among equals, and with SQLite it orders
the jobs of one second and one priority by their random names. `test_a_changed_priority_is_that_of_the_queue` fails where a later version
orders its queues otherwise.
"""

import sqlalchemy as sa

SCHEMAS = {"sqlite": None, "postgresql": "dbos"}
"""The schema of the tables of DBOS, by the kind of database; SQLite has no schemas."""


def set_order(connection: sa.Connection, workflow: str, **values: int) -> None:
    """Set the `priority` of a queued workflow, of which the lowest goes first, or `created_at`, in milliseconds since 1970."""
    workflows = sa.table("workflow_status", sa.column("workflow_uuid", sa.Text), *map(sa.column, values),
                         schema=SCHEMAS[connection.dialect.name])
    connection.execute(workflows.update().where(workflows.c.workflow_uuid == workflow).values(**values))
