"""The sample capture of `relit demo --serve`: registered in the service, with the results of the demo as those of jobs that have ended."""

import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from service.requests.base.base import JobRequest
from service.requests.base.identifiers import CAPTURE, ENVIRONMENT, JOB, new_id
from service.requests.jobs import CheckJob, PipelineJob, ViewJob
from service.requests.relight import RelightOptions
from service.requests.states import REFUSED, SUCCEEDED
from service.server.database import intakes, jobs
from service.server.database.engine import Database
from service.server.database.keys import DEFAULT_PROJECT
from service.server.jobs.queue import JobQueue
from service.server.storage import layout
from service.server.storage.objects import Storage

OPTIONS = RelightOptions(frames="1-24", spin_degrees=360.0)
"""The frames of the demo."""


class SampleResults(NamedTuple):
    """Results that were made of the sample before the service began."""

    pipeline: Sequence[Path]
    """Maps, report, asset and frames."""
    capture_view: Sequence[Path]
    """A view of the capture alone."""
    maps_view: Sequence[Path]
    """A view of the capture with its maps."""


def show_sample(address: str, database: Database, queue: JobQueue, storage: Storage, sample: Path, made: SampleResults | None) -> None:
    """Register the sample and its environment.exr, add results that were made of it unless there are some, and print what to try."""
    capture = _registered(database, queue, CAPTURE, sample)
    sky = _registered(database, queue, ENVIRONMENT, sample / "environment.exr")
    pipeline = PipelineJob(kind="pipeline", capture=capture, environment=sky, relight=OPTIONS)
    if made is not None and not _has_results(database, capture):
        solved = _add(database, storage, pipeline, made.pipeline, [capture, sky])
        _add(database, storage, ViewJob(kind="view", capture=capture, maps=solved), made.maps_view, [capture, solved])
        _add(database, storage, ViewJob(kind="view", capture=capture), made.capture_view, [capture])
    job = json.dumps(pipeline.model_dump(mode="json", exclude_defaults=True) | {"kind": "pipeline"})
    print(f"capture  {address}/v1/captures/{capture}")
    print(f"sky      {address}/v1/environments/{sky}")
    print("try      " + f"curl -s {address}/v1/jobs -H 'Content-Type: application/json' -d '{job}'")
    print(f"         curl -N {address}/v1/jobs/JOB/events; curl -s {address}/v1/jobs/JOB/results")
    print(f"pages    {address}/", flush=True)


def _has_results(database: Database, capture: str) -> bool:
    found = jobs.latest(database, DEFAULT_PROJECT, states=[SUCCEEDED], limit=500)
    return any(row["request"].get("capture") == capture and row["request"]["kind"] == "view" for row in found)


def _add(database: Database, storage: Storage, request: JobRequest, files: Sequence[Path], inputs: Sequence[str]) -> str:
    identifier = new_id(JOB)
    prefix = layout.results(DEFAULT_PROJECT, identifier)
    folder = storage.workspace(prefix)
    for file in files:
        shutil.copyfile(file, folder / f".{file.name}")
        (folder / f".{file.name}").rename(folder / file.name)
    storage.publish(prefix)
    with database.begin() as connection:
        return jobs.insert(connection, project=DEFAULT_PROJECT, request=request, inputs=inputs, finished=identifier)


def _registered(database: Database, queue: JobQueue, kind: str, path: Path) -> str:
    for row in intakes.latest(database, DEFAULT_PROJECT, kind, limit=500):
        if row["folder"] == str(path) and row["state"] != REFUSED:
            return str(row["id"])
    with database.begin() as connection:
        identifier = intakes.insert(connection, project=DEFAULT_PROJECT, kind=kind, name=path.name, folder=path)
        queue.submit(connection, project=DEFAULT_PROJECT, request=CheckJob(kind="check", intake=identifier), inputs=[identifier])
    return identifier
