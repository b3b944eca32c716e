"""The arguments of the steps of a job: the worker that does them, the job, and the files that it reads and writes: captures, environments
and results of other jobs, as folders of this machine."""

import re
import shutil
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import sqlalchemy as sa
from pydantic import BaseModel

from service.errors import RequestError
from service.reporting.progress import Progress
from service.reporting.provenance import name_place
from service.requests.answers import WARNING
from service.requests.base.annotations import page_of
from service.requests.base.base import JobRequest, Options
from service.requests.base.identifiers import CAPTURE, ENVIRONMENT
from service.requests.jobs import ANY_JOB, CheckJob
from service.server.base.settings import Settings
from service.server.database import intakes, jobs
from service.server.database.engine import Database
from service.server.jobs.queue import JobQueue
from service.server.storage import layout
from service.server.storage.objects import Storage
from stage import inputs
from stage.capture.sequence import SEQUENCE_FILE, read_sequence
from stage.files import resolved, write_text

ANNOTATIONS_FILE = "annotations.json"
R = TypeVar("R", bound=Options)
NAMES = ("images", "masks", "dark_images", "reflectances", "table")
"""Fields of jobs with names of files in the folder of their capture; the other fields that requests have too hold identifiers, or a JSON
document."""


class WorkerContext(NamedTuple):
    """Services and settings that the steps of a worker need."""

    settings: Settings
    database: Database
    storage: Storage
    queue: JobQueue
    """The queue in which other workers are asked to help."""
    device: str
    worker: str
    """Name of the worker."""

    def require_space(self) -> None:
        """Raise RequestError if less than `min_free_bytes` are left in the data folder."""
        if shutil.disk_usage(self.settings.data).free < self.settings.min_free_bytes:
            raise RequestError("the service has no space left for this job (min_free_bytes): retry it when there is")


class Job(NamedTuple):
    """The parts of a job's row that its steps need."""

    id: str
    project: str
    request: JobRequest
    chunk_frames: int
    attempt: int = 1
    is_resumed: bool = False
    """True if the job has lost a worker since it last made progress."""

    @classmethod
    def of(cls, row: sa.RowMapping | Mapping[str, Any]) -> "Job":
        """Read a row of the jobs table."""
        return cls(row["id"], row["project"], ANY_JOB.validate_python(row["request"]), row["chunk_frames"], row["attempt"],
                   row["lost"] > 0 or row["lost_repeating"] > 0)


class StepFiles(NamedTuple):
    """The files of a step that runs, and what else its product is given."""

    job: Job
    context: WorkerContext
    progress: Progress
    held: ExitStack
    """Closes what is opened for the step when it ends."""

    @classmethod
    @contextmanager
    def of(cls, job: Job, context: WorkerContext, progress: Progress) -> "Iterator[StepFiles]":
        """Yield the files of a step while it runs; images are decoded in processes of their own."""
        from service.captures.decoders import Decoders
        from stage.formats import images

        with ExitStack() as held:
            if not isinstance(job.request, CheckJob):  # which does not decode, and may run beside another step
                decoders = held.enter_context(closing(Decoders(context.settings.max_pixels)))
                held.enter_context(images.decoded_by(decoders))
            yield cls(job, context, progress, held)

    def tell(self, result: object) -> None:
        """Write the warnings that a product's result has, if it has any, into the log of the job."""
        if warnings := tuple(getattr(result, "warnings", ())):
            jobs.note_once(self.context.database, self.job.id,
                           [without_places(f"{WARNING}{warning}", self.job.id, self.context) for warning in warnings])

    def cache(self, capture: str) -> Path:
        """Return the folder of the image stack of a capture."""
        return self.context.settings.cache / capture

    def request(self, model: type[R], job: JobRequest, **given: Any) -> R:
        """Return the request of a product: values `given`, options of a job, and folders and files for its identifiers and names."""
        values = {**dict(getattr(job, "options", ())), **given}
        for name in type(job).model_fields:
            if name in model.model_fields and name not in JobRequest.model_fields and name not in values:
                values[name] = self._place(name, getattr(job, name), values.get("capture"))
        capture = next(iter(getattr(job, "captures", ())), getattr(job, "capture", None))
        ours = {"device": self.context.device, "cache": None if capture is None else self.cache(capture)}
        return model(**({name: value for name, value in ours.items() if name in model.model_fields} | values))

    def _place(self, field: str, value: Any, capture: Path | None) -> Any:
        """Return the file or folder that the value of a job's field stands for; a document is written as FIELD.json among the results."""
        if value is None:
            return None
        if isinstance(value, tuple):
            return tuple(self._place(field, each, capture) for each in value)
        if isinstance(value, BaseModel):
            path = self.out / f"{field}.json"
            write_text(path, value.model_dump_json(by_alias=True, indent=2, exclude_defaults=True) + "\n")
            return path
        if field in NAMES:
            assert capture is not None, "it is a field of all jobs with such names"
            return file_within(capture, value, field)
        if value.startswith(ENVIRONMENT):
            from service.captures.admit import environment_file

            return environment_file(self.intake(value))
        return self.intake(value) if value.startswith(CAPTURE) else self.maps(value)

    @property
    def out(self) -> Path:
        """Folder into which the results of the job are written."""
        return _named(self.context.storage.workspace(layout.results(self.job.project, self.job.id)), self.job.id)

    def maps(self, job: str) -> Path:
        """Return the folder with the maps of a job of the same project, or of this job; of a sequence with those of each time step."""
        storage, prefix = self.context.storage, layout.results(self.job.project, job)
        folder = _named(storage.local(prefix, layout.SOLVED, self.progress), job)
        if (folder / SEQUENCE_FILE).is_file():
            storage.local(prefix, [f"{step.name}/{name}" for step in read_sequence(folder).steps for name in layout.SOLVED], self.progress)
        return folder

    def intake(self, identifier: str, number: int | None = None) -> Path:
        """Return the folder of a capture or environment; a registered one, or its time step `number`, is checked again as it may change."""
        from service.captures.admit import admit_environment, recheck_capture

        folder, root = self.intake_place(identifier)
        if root is not None and identifier.startswith(CAPTURE):
            recheck_capture(folder, max_pixels=self.context.settings.max_pixels, number=number)
        elif root is not None:
            admit_environment(folder, max_pixels=self.context.settings.max_pixels)
        return folder

    def intake_place(self, identifier: str) -> tuple[Path, Path | None]:
        """Return the folder of a capture (file of an environment) and the root of a registered one, opened beneath it until a step ends."""
        project, context = self.job.project, self.context
        row = intakes.find(context.database, identifier, project)
        if row is None:
            raise RequestError(f"{identifier}: is not there any more")
        if row["folder"] is None:
            return _named(context.storage.local(layout.intake(project, identifier), progress=self.progress), identifier), None
        folder = Path(row["folder"])
        root = next((root for root in context.settings.roots_of(project) if folder.is_relative_to(root)), None)
        if root is None or resolved(folder) != folder or not folder.exists():
            raise RequestError(f"{identifier}: is not where it was registered any more, or in none of the folders that the operator allows")
        top = folder if identifier.startswith(CAPTURE) else folder.parent
        self.held.enter_context(inputs.confined(top, root, max_pixels=context.settings.max_pixels))
        return _named(folder, identifier), root

    @contextmanager
    def linked(self, jobs: Iterable[str], name: str) -> Iterator[Path]:
        """Make a folder with links to the results of jobs, each by its identifier; reports have `name` for the folder."""
        with tempfile.TemporaryDirectory(prefix="relit-linked-") as made:
            folder = _named(Path(made), name)
            for job in set(jobs):
                (folder / job).symlink_to(self.maps(job), target_is_directory=True)
            yield folder

    def write_annotations(self, source: str) -> None:
        """Write the annotations of a capture, or of that which a job began with, beside the results of this job; none: no file."""
        database, found = self.context.database, source
        while not found.startswith(CAPTURE):
            job = jobs.find(database, found, self.job.project)
            found = "" if job is None else job["request"].get("capture") or job["request"].get("maps") or ""
            if not found:
                return
        if rows := intakes.annotations_of(database, found):
            write_text(self.out / ANNOTATIONS_FILE, page_of(found, rows).model_dump_json(by_alias=True, indent=1) + "\n")


class JobStep(NamedTuple):
    """A part of a job that is done as a whole or again."""

    name: str
    run: Callable[[StepFiles], None]
    frames: int = 0
    """Number of frames that the step makes, at the same time as other workers make those of other steps."""
    made: Callable[[], int] = lambda: 0
    """Returns how many of these frames this machine has."""
    help: Callable[[StepFiles], None] | None = None
    """A function that does pieces of the step beside the worker that runs it; None: it cannot be divided."""


def file_within(capture: Path, name: str, field: str) -> Path:
    """Return the path of a file in the folder of a capture, which must not lead out of it, beside those that the manifest names."""
    place = None if "\0" in name else resolved(capture / name)
    if place is None or not place.is_relative_to(capture.resolve()):
        raise RequestError(f"{field}: {name!r} leads out of the capture's folder")
    if not place.is_file():
        raise RequestError(f"{field}: {name!r} is no file of the capture")
    return capture / name


def without_places(text: str, job: str, context: WorkerContext) -> str:
    """Return the sentence of a job's error with identifiers and names in place of folders of the server, which are not users' to know."""
    names = {f"{context.settings.data}/": ""}
    for row in intakes.read_by(context.database, job):
        names |= {f"{root}/": "" for root in context.settings.roots_of(row["project"])}
        if row["folder"] is not None:
            names[row["folder"]] = row["id"] if row["kind"] == CAPTURE else Path(row["folder"]).name
    for place in sorted(names, key=len, reverse=True):
        text = text.replace(place, names[place])
    text = re.sub(r"\bprojects/[^/\s]+/(?:captures|environments|jobs)/", "", text).replace(f"{job}/", "")
    return re.sub(rf"{re.escape(tempfile.gettempdir())}/relit-[^/\s]+/", "", text)  # folders that a step made of links to results


def _named(place: Path, identifier: str) -> Path:
    """Return a place of the server, which reports then name by its identifier."""
    name_place(place, identifier)
    return place
