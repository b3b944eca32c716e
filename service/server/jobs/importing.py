"""Files without a manifest that were uploaded: a proposal of what they are, and their import as a capture.

Both are done in a hidden folder of links to the files, among the results of the job, by a process of its own; so nothing of an import
that fails or is killed is in the capture, and it is done again from the beginning. What a killed one left goes with the job.
"""

import stat
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import sqlalchemy as sa

from service.captures.check_process import check_in_process, import_in_process, propose_in_process
from service.errors import RequestError
from service.requests import jobs
from service.requests.states import CHECKING
from service.server.base.safe_names import folded
from service.server.database import intakes, quotas, uploads
from service.server.jobs.context import StepFiles
from service.server.storage import layout
from stage.capture.manifest import FILE_NAME
from stage.errors import storage
from stage.importers.layout import place_images

MOST_FILES = 1_000_000
MADE = (FILE_NAME, ".npy")
"""The endings of the names of files that imports make."""


def look(request: jobs.CheckJob, files: StepFiles) -> None:
    """Record how the files of a capture can be imported."""
    with _links(request.intake, files) as (folder, _):
        proposal = propose_in_process(folder, max_pixels=files.context.settings.max_pixels, progress=files.progress)
    intakes.propose(files.context.database, request.intake, proposal)


def import_files(request: jobs.CheckJob, files: StepFiles) -> None:
    """Import the files of a capture as the request says, check what was made, and let the capture be ready with it."""
    from service.captures.importing import still_assumed

    context, job, choices = files.context, files.job, request.importing
    max_pixels = context.settings.max_pixels
    row = intakes.find(context.database, request.intake, job.project)
    if row is None or choices is None:
        raise RequestError(f"{request.intake}: is not there any more")
    if row["state"] != CHECKING:  # a run that was killed after it had let the capture be ready
        return
    delete_strays(request.intake, files)
    proposal = (row["facts"] or {}).get(intakes.PROPOSAL)
    with _links(request.intake, files) as (folder, given):
        import_in_process(folder, choices, () if proposal is None else still_assumed(proposal, choices), row["name"],
                          max_pixels=max_pixels, progress=files.progress)
        facts = check_in_process(folder, environment=False, root=None, max_pixels=max_pixels, progress=files.progress)
        made = _made(folder, given)

        def allow(connection: sa.Connection) -> None:
            quotas.require(connection, context.settings, quotas.BYTES, job.project, sum(made.values()))
            quotas.require(connection, context.settings, quotas.PIXELS, job.project, quotas.pixels_of(facts))

        def record(connection: sa.Connection) -> None:
            allow(connection)
            for name, length in made.items():
                uploads.insert(connection, project=job.project, intake=request.intake, path=name, length=length, made=True)

        context.database.transact(allow)  # asked again where it counts
        place = layout.intake(job.project, request.intake)
        try:
            for name in made:
                context.storage.put(folder / name, place, name)
            intakes.accept(context.database, request.intake, facts, record)
        except Exception:
            now = intakes.find(context.database, request.intake, job.project)
            if now is None or now["state"] == CHECKING:
                for name in made:
                    context.storage.delete(place, name)
            raise


def delete_strays(intake: str, files: StepFiles) -> None:
    """Delete what lies among the files of an upload that is checking and was never recorded: an import that was killed has left it."""
    row = intakes.find(files.context.database, intake, files.job.project)
    if row is None or row["state"] != CHECKING or row["folder"] is not None:
        return
    known = {upload["folded"] for upload in uploads.listing(files.context.database, intake, limit=MOST_FILES)}
    place = layout.intake(files.job.project, intake)
    for file in files.context.storage.files(place):
        if folded(file.name) not in known:
            files.context.storage.delete(place, file.name)


@contextmanager
def _links(intake: str, files: StepFiles) -> Iterator[tuple[Path, frozenset[str]]]:
    """Yield a folder with links to the uploaded files of a capture, copies where there are no links, and their names."""
    rows = uploads.listing(files.context.database, intake, limit=MOST_FILES)
    names = frozenset(row["path"] for row in rows)
    if (own := next((row["path"] for row in rows if row["folded"] == FILE_NAME), None)) is not None:
        raise RequestError(f"{own}: was uploaded and stays as it is: validate the capture, or delete this file to import the others")
    source, root = files.intake_place(intake)
    if root is not None:
        raise RequestError(f"{intake}: is registered, and stays as it is: relit import writes its {FILE_NAME} where it lies")
    work = files.context.storage.workspace(layout.results(files.job.project, files.job.id))
    with storage("write", work), tempfile.TemporaryDirectory(prefix=".import-", dir=work) as made:
        folder = Path(made) / "files"
        folder.mkdir()
        place_images(source, folder, sorted(names))
        yield folder, names


def _made(folder: Path, given: frozenset[str]) -> dict[str, int]:
    """Return the names and lengths of the files that an import made; refuse anything else that is new."""
    made: dict[str, int] = {}
    for path in sorted(folder.rglob("*")):
        name, found = path.relative_to(folder).as_posix(), path.lstat()
        if name in given or stat.S_ISDIR(found.st_mode):
            continue
        if not stat.S_ISREG(found.st_mode) or found.st_nlink != 1 or not name.endswith(MADE):
            raise RequestError(f"{name}: is named by the files, and was not uploaded with them")
        made[name] = found.st_size
    return made
