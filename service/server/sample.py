"""The sample capture of `relit demo --serve`: registered in the service, with commands to try."""

import json
from pathlib import Path

import sqlalchemy as sa

from service.requests.identifiers import CAPTURE, ENVIRONMENT, new_id
from service.requests.jobs import CheckJob
from service.server.database import intakes
from service.server.database.engine import Database
from service.server.database.keys import DEFAULT_PROJECT
from service.server.jobs.queue import JobQueue
from service.views.states import REFUSED


def show_sample(address: str, database: Database, queue: JobQueue, sample: Path) -> None:
    """Register the sample and its environment, and print commands that use them.

    Args:
        address: of the service.
        database, queue: of the service.
        sample: folder of the capture, with environment.exr.
    """
    capture = _registered(database, queue, CAPTURE, sample)
    sky = _registered(database, queue, ENVIRONMENT, sample / "environment.exr")
    job = json.dumps({"kind": "pipeline", "capture": capture, "environment": sky, "relight": {"frames": "1-24", "spin_degrees": 360}})
    print(f"capture  {address}/v1/captures/{capture}")
    print(f"sky      {address}/v1/environments/{sky}")
    print("try      " + f"curl -s {address}/v1/jobs -H 'Content-Type: application/json' -d '{job}'")
    print(f"         curl -N {address}/v1/jobs/JOB/events; curl -s {address}/v1/jobs/JOB/results", flush=True)


def _registered(database: Database, queue: JobQueue, kind: str, path: Path) -> str:
    """Return the identifier of a path, which is registered if it is not yet."""
    for row in intakes.latest(database, DEFAULT_PROJECT, kind, limit=500):
        if row["folder"] == str(path) and row["state"] != REFUSED:
            return str(row["id"])
    identifier = new_id(kind)

    def work(connection: sa.Connection) -> None:
        intakes.insert(connection, identifier=identifier, project=DEFAULT_PROJECT, kind=kind, name=path.name, folder=str(path))
        queue.submit(connection, project=DEFAULT_PROJECT, key=None, request=CheckJob(kind="check", intake=identifier), chunk_frames=1,
                     inputs=[identifier])

    database.transact(work)
    return identifier
