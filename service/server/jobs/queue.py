"""The queue, for those who submit and cancel jobs.

DBOS keeps the queue: a workflow for each attempt of a job. The row of the job and its workflow are written in one transaction, so that
neither exists without the other.
"""

import secrets
import time
from typing import Any

import sqlalchemy as sa
from dbos import DBOS, DBOSClient, DBOSPortableJSONSerializer

from service.requests.base.base import JobRequest
from service.requests.jobs import CheckJob
from service.server.base.settings import Settings
from service.server.database import jobs
from service.server.database.engine import Database
from service.server.database.jobs import Claim
from service.server.database.schema import upgrade

WORK, CHECKS = "work", "checks"
"""The queues: jobs that need a device, and quick checks of captures and environments."""
WORKFLOW = "relit.job"
HELP = "relit.help"
"""The workflow of a worker that helps another with its job."""
VERSION = "1"
"""Version of the workflow: a worker takes only jobs that were queued by the same version."""
SERIALIZER = DBOSPortableJSONSerializer()
HIGHEST = 101
"""DBOS starts the lowest priority first and counts from 1; a request's highest priority, 100, goes first."""
SCHEMAS = {"sqlite": None, "postgresql": "dbos"}
"""The schema of the tables of DBOS, by the kind of database; SQLite has no schemas."""


def prepare(settings: Settings, database: Database) -> None:
    """Make the data folder, and the tables of the service and of the queue, if they do not exist."""
    settings.data.mkdir(parents=True, exist_ok=True)
    upgrade(database)
    DBOS.migrate(settings.sqlalchemy_url)


def set_order(connection: sa.Connection, workflow: str, **values: int) -> None:
    """Set the `priority` of a queued workflow, of which the lowest goes first, or `created_at`, in milliseconds since 1970.

    This writes a table of DBOS, which no public call does: DBOS 3.4 sets the priority of a workflow only when it is queued, a new attempt
    would lose the place among equals, and with SQLite it orders the jobs of one second and one priority by their random names.
    `test_a_changed_priority_is_that_of_the_queue` fails where a later version orders its queues otherwise.
    """
    workflows = sa.table("workflow_status", sa.column("workflow_uuid", sa.Text), *map(sa.column, values),
                         schema=SCHEMAS[connection.dialect.name])
    connection.execute(workflows.update().where(workflows.c.workflow_uuid == workflow).values(**values))


def workflow_id(job: str, attempt: int) -> str:
    """Return the name of the workflow of an attempt."""
    return f"{job}.{attempt}"


def job_and_attempt(workflow: str) -> tuple[str, int]:
    """Return the job and the attempt of a workflow."""
    job, attempt, *_ = workflow.split(".")
    return job, int(attempt)


def is_help(workflow: str) -> bool:
    """Return whether a workflow is that of a worker that helps another with its job."""
    return workflow.count(".") > 1


class JobQueue:
    """Submits, cancels and returns jobs."""

    def __init__(self, database: Database) -> None:
        self._database = database
        self._client = DBOSClient(system_database_engine=database.engine, serializer=SERIALIZER, lazy=True, retry_connection_errors=False)

    def submit(self, connection: sa.Connection, *, project: str, request: JobRequest, **more: Any) -> str:
        """Record a new job and queue it in the caller's transaction; the arguments are those of `jobs.insert`."""
        job = jobs.insert(connection, project=project, request=request, **more)
        self.enqueue(connection, job, 1, request, request.priority, project)
        return job

    def enqueue(self, connection: sa.Connection, job: str, attempt: int, request: JobRequest, priority: int, project: str) -> None:
        """Queue an attempt of a job in the caller's transaction: behind the project's jobs of higher priority, and not behind others'."""
        queue = CHECKS if isinstance(request, CheckJob) else WORK
        self._enqueue(connection, WORKFLOW, queue, workflow_id(job, attempt), priority, project, job, attempt)
        set_order(connection, workflow_id(job, attempt), created_at=int(time.time() * 1000))

    def set_priority(self, connection: sa.Connection, job: str, attempt: int, priority: int) -> None:
        """Change the priority of a queued attempt in the caller's transaction; its place among equal priorities stays."""
        set_order(connection, workflow_id(job, attempt), priority=HIGHEST - priority)

    def cancel(self, workflow: str) -> None:
        """Take an attempt or a help out of the queue; a worker that has it learns so from the job's row at its next sign of progress."""
        self._client.cancel_workflow(workflow)

    def ask_for_help(self, job: str, attempt: int, priority: int, workers: int, project: str) -> None:
        """Queue work for workers that have no other: to help with a job that another worker does."""
        with self._database.begin() as connection:
            for _ in range(workers):
                workflow = f"{workflow_id(job, attempt)}.{secrets.token_hex(4)}"
                self._enqueue(connection, HELP, WORK, workflow, priority, project, workflow)

    def _enqueue(self, connection: sa.Connection, name: str, queue: str, workflow: str, priority: int, project: str, *given: Any) -> None:
        self._client.enqueue_in_transaction(connection, {
            "workflow_name": name, "queue_name": queue, "workflow_id": workflow, "app_version": VERSION, "priority": HIGHEST - priority,
            "queue_partition_key": project}, *given)

    def workers_on(self, job: str) -> set[str]:
        """Return the names of the workers that do a job or help with it."""
        return {worker for worker, workflows in self.taken_by().items() if any(name.startswith(f"{job}.") for name in workflows)}

    def taken_by(self) -> dict[str, list[str]]:
        """Return the workflows that have begun and not ended, by the worker that has them."""
        found: dict[str, list[str]] = {}
        for status in self._client.list_workflows(status="PENDING", app_version=VERSION, load_input=False, load_output=False):
            found.setdefault(status.executor_id or "", []).append(status.workflow_id)
        return found

    def return_job(self, workflow: str, worker: str) -> None:
        """Queue a workflow again that the calling worker had taken and does not finish."""
        with self._database.begin() as connection:
            released = not is_help(workflow) and jobs.release(connection, Claim(*job_and_attempt(workflow), worker))
        if released:
            self.requeue(workflow)
        else:  # also of help, as the worker that has the job does what is left
            self.cancel(workflow)

    def requeue(self, workflow: str) -> None:
        """Queue a workflow again that a worker had taken; its place in the queue is the one that it had."""
        job, _ = job_and_attempt(workflow)
        row = jobs.find(self._database, job)
        if row is not None:
            self._client.resume_workflow(workflow, queue_name=CHECKS if row["request"]["kind"] == "check" else WORK)

    def forget(self, job: str) -> None:
        """Delete the workflows of all attempts of a job, and of the workers that helped."""
        found = self._client.list_workflows(workflow_id_prefix=f"{job}.", load_input=False, load_output=False)
        self._client.delete_workflows([status.workflow_id for status in found])
