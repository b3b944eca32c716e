"""Where the files are that a job reads and writes: captures, environments and results of other jobs, as folders of this machine."""

from pathlib import Path

from service.errors import RequestError
from service.reporting.progress import Progress
from service.reporting.provenance import name_place
from service.requests.identifiers import CAPTURE
from service.server.database import intakes
from service.server.jobs.context import Job, WorkerContext
from service.server.storage import layout
from stage import inputs
from stage.files import resolved
from stage.sequence import SEQUENCE_FILE, TimeStep, read_sequence


def results_folder(job: Job, context: WorkerContext) -> Path:
    """Return the folder into which the results of a job are written."""
    return _named(context.storage.workspace(layout.results(job.project, job.id)), job.id)


def job_maps(job: Job, maps: str, context: WorkerContext, progress: Progress) -> Path:
    """Return the folder with the maps of `maps`, a job of the same project or this job; of a sequence with those of each time step."""
    prefix = layout.results(job.project, maps)
    folder = _named(context.storage.local(prefix, layout.SOLVED, progress), maps)
    if (folder / SEQUENCE_FILE).is_file():
        steps = read_sequence(folder).steps
        context.storage.local(prefix, [f"{step.name}/{name}" for step in steps for name in layout.SOLVED], progress)
    return folder


def intake_folder(job: Job, identifier: str, context: WorkerContext, progress: Progress, number: int | None = None) -> Path:
    """Return the folder of a capture or environment of the job's project; a registered one is checked again, as it may have changed.

    Args:
        job: reads it.
        identifier: of the intake.
        context: of the worker.
        progress: of files that are fetched.
        number: of the only time step of a sequence whose images are read, from 1; None: all are.
    """
    from service.captures.admit import admit_environment, recheck_capture

    folder, root = intake_place(job, identifier, context, progress)
    if root is not None and identifier.startswith(CAPTURE):
        recheck_capture(folder, max_pixels=context.max_pixels, number=number)
    elif root is not None:
        admit_environment(folder, max_pixels=context.max_pixels)
    return folder


def time_step(sequence: Path, number: int) -> TimeStep:
    """Return a time step of a sequence of captures.

    Args:
        sequence: folder of its capture.
        number: of the step, from 1.

    Raises:
        ManifestError: it has fewer steps by now.
    """
    return read_sequence(sequence).step(number, sequence)


def intake_place(job: Job, identifier: str, context: WorkerContext, progress: Progress) -> tuple[Path, Path | None]:
    """Return the folder (or the file of an environment) of an intake of the job's project, and the root of a registered one.

    The files of a registered one are opened beneath its folder until the step ends, whatever becomes links meanwhile.
    """
    row = intakes.find(context.database, identifier, job.project)
    if row is None:
        raise RequestError(f"{identifier}: is not there any more")
    if row["folder"] is None:
        return _named(context.storage.local(layout.intake(job.project, identifier), progress=progress), identifier), None
    folder = Path(row["folder"])
    root = next((root for root in context.roots_of(job.project) if folder.is_relative_to(root)), None)
    if resolved(folder) != folder or root is None:
        raise RequestError(f"{identifier}: lies in none of the folders that the operator allows any more")
    top = folder if identifier.startswith(CAPTURE) else folder.parent
    context.held.enter_context(inputs.confined(top, root, max_pixels=context.max_pixels))
    return _named(folder, identifier), root


def environment_image(job: Job, identifier: str | None, context: WorkerContext, progress: Progress) -> Path | None:
    """Return the image of an environment, or None where there is none."""
    from service.captures.admit import environment_file

    return None if identifier is None else environment_file(intake_folder(job, identifier, context, progress))


def without_places(text: str, job: str, context: WorkerContext) -> str:
    """Return a sentence for users of the service, without the folders of the server, whose places are not theirs to know.

    A registered capture or environment is named by its identifier. Any other file is named below the data folder or the root.

    Args:
        text: the sentence, of an error.
        job: identifier of the job that it is about.
        context: of the worker.
    """
    names = {f"{context.cache.parent}/": ""}
    for row in intakes.read_by(context.database, job):
        names |= {f"{root}/": "" for root in context.roots_of(row["project"])}
        if row["folder"] is not None:
            names[row["folder"]] = row["id"]
    for place in sorted(names, key=len, reverse=True):
        text = text.replace(place, names[place])
    return text


def _named(place: Path, identifier: str) -> Path:
    """Return a place of the server, which reports then name by its identifier."""
    name_place(place, identifier)
    return place
