"""The door to the queue: for those who hand jobs in, and not for those who do them.

A job of the store is a workflow an attempt. Both are written in one transaction, so that there is never one without the other.
"""

import sqlalchemy as sa
from dbos import DBOS, DBOSClient, DBOSPortableJSONSerializer

from service.requests.jobs import CheckJob, JobRequest
from service.server.database import jobs
from service.server.database.engine import Database, create
from service.server.database.jobs import Claim
from service.server.settings import Settings

WORK, CHECKS = "work", "checks"
"""Queues: of what takes a device, and of quick looks at what came in."""
WORKFLOW = "relit.job"
VERSION = "1"
"""Of the steps of workflows: a job is finished by a worker of the version that began it."""
SERIALIZER = DBOSPortableJSONSerializer()
HIGHEST = 101
"""The queue counts priorities from 1, the first to go; requests from 0 to 100, the last to go."""


def prepare(settings: Settings, database: Database) -> None:
    """Make the tables of the service and of the queue where there are none.

    Raises:
        DatabaseError: they are those of another version.
    """
    settings.data.mkdir(parents=True, exist_ok=True)
    create(database)
    DBOS.migrate(settings.sqlalchemy_url)


def workflow_id(job: str, attempt: int) -> str:
    """Name of the workflow of an attempt."""
    return f"{job}.{attempt}"


def job_of(workflow: str) -> tuple[str, int]:
    """The job and the attempt that a workflow is."""
    job, _, attempt = workflow.rpartition(".")
    return job, int(attempt)


class JobQueue:
    """Hands jobs in and calls them off."""

    def __init__(self, database: Database) -> None:
        """Args: database: of the store; must be prepared."""
        self._database = database
        self._client = DBOSClient(system_database_engine=database.engine, serializer=SERIALIZER, lazy=True, retry_connection_errors=False)

    def submit(self, connection: sa.Connection, *, project: str, key: str | None, request: JobRequest, chunk_frames: int,
               inputs: list[str], trace: str | None = None) -> str:
        """Write down a new job and queue it, in the caller's transaction; arguments as `jobs.insert`."""
        job = jobs.insert(connection, project=project, key=key, request=request, chunk_frames=chunk_frames, inputs=inputs,
                          trace=trace)
        self.enqueue(connection, job, 1, request)
        return job

    def enqueue(self, connection: sa.Connection, job: str, attempt: int, request: JobRequest, priority: int | None = None) -> None:
        """Queue an attempt, in the caller's transaction."""
        self._client.enqueue_in_transaction(connection, {
            "workflow_name": WORKFLOW, "queue_name": CHECKS if isinstance(request, CheckJob) else WORK,
            "workflow_id": workflow_id(job, attempt), "app_version": VERSION,
            "priority": HIGHEST - (request.priority if priority is None else priority),
        }, job, attempt)

    def cancel(self, job: str, attempt: int) -> None:
        """Take an attempt from the queue; one that runs is told by the store, and ends at its next sign of progress."""
        self._client.cancel_workflow(workflow_id(job, attempt))

    def taken_by(self) -> dict[str, list[str]]:
        """Workflows that have begun and not ended, by the worker that has them."""
        found: dict[str, list[str]] = {}
        for status in self._client.list_workflows(status="PENDING", app_version=VERSION, load_input=False, load_output=False):
            found.setdefault(status.executor_id or "", []).append(status.workflow_id)
        return found

    def return_job(self, workflow: str, worker: str) -> None:
        """Queue what the caller, a worker, had begun and will not go on with."""
        job, attempt = job_of(workflow)
        if self._database.transact(lambda connection: jobs.release(connection, Claim(job, attempt, worker))):
            self.requeue(workflow)
        else:
            self.cancel(job, attempt)

    def requeue(self, workflow: str) -> None:
        """Queue what a worker had begun; its place in the queue is the one that it had."""
        job, _ = job_of(workflow)
        row = jobs.find(self._database, job)
        if row is not None:
            self._client.resume_workflow(workflow, queue_name=CHECKS if row["request"]["kind"] == "check" else WORK)

    def forget(self, job: str, attempts: int) -> None:
        """Remove the workflows of a job."""
        self._client.delete_workflows([workflow_id(job, attempt) for attempt in range(1, attempts + 1)])
