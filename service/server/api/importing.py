"""Routes for folders without a capture.json: which of their files are needed, what the uploaded files seem to be, and their import."""

from pathlib import Path as FilePath
from typing import Annotated

from fastapi import APIRouter, Body, Path
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from service.errors import sentence
from service.requests.answers import CaptureFiles, IntakeView, NeededFile, NeededFiles
from service.requests.base.identifiers import CAPTURE, pattern
from service.requests.imports.layouts import ImportChoices, leads_out, request_of
from service.requests.jobs import CheckJob
from service.server.api.context import FOR_WORK, Reader, Service, ServiceDep, Writer, require_space
from service.server.api.intakes import begin_check, row_of
from service.server.api.json_body import JsonRoute
from service.server.api.problems import ApiError, responses
from service.server.base.safe_names import MAX_PATH_BYTES, check_path
from service.server.database.keys import Caller
from stage.errors import StageError

router = APIRouter(prefix="/v1/captures", tags=["captures"], responses=responses(401, 403, 422, 429, 503), route_class=JsonRoute)
MOST_LISTED = 20_000
CaptureIdPath = Annotated[str, Path(alias="capture", pattern=pattern(CAPTURE))]


class ListedFile(BaseModel):
    """A file of a folder that is to be uploaded."""

    model_config = ConfigDict(extra="forbid")

    path: Annotated[str, Field(min_length=1, max_length=MAX_PATH_BYTES)]
    """Below the folder, with / between folders."""
    length: Annotated[int, Field(ge=0)]
    """Bytes."""


class FolderListing(BaseModel):
    """The files of a folder."""

    model_config = ConfigDict(extra="forbid")

    files: Annotated[list[ListedFile], Field(min_length=1, max_length=MOST_LISTED)]


@router.post("/needed-files", summary="Say which files of a folder are needed")
def needed_files(_caller: Reader, listing: Annotated[FolderListing, Body(openapi_examples={"photographs": {
        "value": {"files": [{"path": "000.png", "length": 90210}, {"path": "lights.txt", "length": 3000}]}}})]) -> NeededFiles:
    """Return the captures that a folder without a capture.json may hold, and the files of each, told from names and lengths alone: so
    nothing else is uploaded. Each is then created, uploaded, and looked at by `guess`."""
    from stage.importers.needed import needed_files as find

    lengths = {file.path: file.length for file in listing.files}
    try:
        found = find(lengths)
    except StageError as error:
        raise ApiError("invalid", sentence(error)) from error
    for needed in found:
        for name in needed.files.values():
            check_path(name)
    return NeededFiles(captures=[CaptureFiles(folder=needed.folder, files=[
        NeededFile(path=path, name=name, length=lengths[path]) for path, name in needed.files.items()]) for needed in found])


@router.post("/{capture}/guess", status_code=202, responses=responses(404, 409, 507), summary="Say what uploaded files seem to be")
def guess_capture(service: ServiceDep, caller: Writer, capture: CaptureIdPath) -> IntakeView:
    """Look at the files of a capture that has no capture.json, as `relit import guess` does. While it is `checking` it takes no files; then
    it is `receiving` again, and its fact `proposal` says what the files are and what is to be chosen; or it is `refused`."""
    return _begin(service, caller, CheckJob(kind="check", intake=capture, guess=True), "intake.guess")


@router.post("/{capture}/import", status_code=202, responses=responses(404, 409, 507), summary="Import uploaded files as a capture")
def import_capture(service: ServiceDep, caller: Writer, capture: CaptureIdPath, choices: Annotated[ImportChoices, Body(openapi_examples={
        "photographs": {"value": {"layout": "photos", "options": {"color_space": "srgb_texture"}}}})]) -> IntakeView:
    """Write the capture.json of uploaded files, as `relit import` does, and check the capture: it is `ready` then, or `refused`, and can be
    imported otherwise."""
    if (name := next((name for name, value in choices.options.items() if leads_out(value)), None)) is not None or leads_out(choices.file):
        raise ApiError("invalid", f"{name or 'file'}: leads out of the capture: name a file of it")
    try:
        request_of(choices.layout, FilePath(), None, choices.options)
    except ValidationError as error:
        raise ApiError("invalid", sentence(error)) from error
    return _begin(service, caller, CheckJob(kind="check", intake=capture, importing=choices), "intake.import")


def _begin(service: Service, caller: Caller, job: CheckJob, action: str) -> IntakeView:
    require_space(service, FOR_WORK)
    if row_of(service, caller, job.intake)["folder"] is not None:
        raise ApiError("conflict", f"{job.intake} is registered, and stays as it is: relit import writes its capture.json where it lies")
    return begin_check(service, caller, job, action)
