"""The place of a job in its queue, for which DBOS has no call: the one file that knows a table of DBOS.

DBOS 3.4 sets the priority of a workflow only when it is queued, and a new attempt would lose the place among equals. With SQLite it counts
whole seconds, and orders the jobs of one second and one priority by their random names. So this writes the two columns by which DBOS orders
its queues; `test_workers_take_jobs_by_priority_and_time_and_projects_take_turns` fails if a later version orders them otherwise.
"""

import sqlalchemy as sa

SCHEMAS = {"sqlite": None, "postgresql": "dbos"}
"""The schema of the tables of DBOS, by the kind of database; SQLite has no schemas."""


def set_order(connection: sa.Connection, workflow: str, **values: int) -> None:
    """Set the priority of a queued workflow, of which the lowest goes first, or `created_at`, in milliseconds since 1970."""
    workflows = sa.table("workflow_status", sa.column("workflow_uuid", sa.Text), *map(sa.column, values),
                         schema=SCHEMAS[connection.dialect.name])
    connection.execute(workflows.update().where(workflows.c.workflow_uuid == workflow).values(**values))
