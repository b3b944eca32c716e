"""Routes of captures and environments: create for an upload, or register where they lie on the server; check, list, annotate, delete."""

import os
from collections.abc import Callable, Sequence
from pathlib import Path as FilePath
from typing import Annotated

import sqlalchemy as sa
from fastapi import APIRouter, Body, Path, Query, Response
from pydantic import BaseModel, ConfigDict, Field

from service.errors import RequestError
from service.requests import states
from service.requests.answers import IntakePage, IntakeView
from service.requests.base.annotations import AnnotationPage, AnnotationView, NewAnnotation, page_of, view_of
from service.requests.base.identifiers import CAPTURE, ENVIRONMENT, AnnotationId, CaptureId, pattern
from service.requests.demo import sample_folder
from service.requests.jobs import CheckJob
from service.requests.keys import Scope
from service.server.api.context import FOR_WORK, IdempotencyKey, Reader, Service, ServiceDep, Writer, require_space
from service.server.api.jobs import StrictJson
from service.server.api.json_body import JsonRoute
from service.server.api.limits import CREATION_COST
from service.server.api.problems import ApiError, found_in_project, responses
from service.server.api.submission import submit
from service.server.base.safe_names import shown
from service.server.database import audit, idempotency, intakes, jobs, quotas, uploads
from service.server.database.keys import Caller
from service.server.storage import layout
from stage.files import resolved
from stage.model import Line

Limit = Annotated[int, Query(ge=1, le=500)]
Name = Annotated[str, Field(min_length=1, max_length=200, pattern=r"^[^\x00-\x1f\x7f]+$")]


class NewCapture(BaseModel):
    """A capture to create."""

    model_config = ConfigDict(extra="forbid")

    name: Name
    folder: Line | None = None
    """Folder of the server below one of its roots; the capture is used where it lies. Needs the scope admin; null: files are uploaded."""


class NewEnvironment(BaseModel):
    """An environment to create."""

    model_config = ConfigDict(extra="forbid")

    name: Name
    file: Line | None = None
    """File of the server below one of its roots, as `folder` of a capture."""


def row_of(service: Service, caller: Caller, identifier: str) -> sa.RowMapping:
    """Return the row of a capture or environment of the caller's project, or refuse the request."""
    return found_in_project(intakes.find(service.database, identifier, caller.project), identifier)


def _view(service: Service, caller: Caller, identifier: str) -> IntakeView:
    return _views(service, [row_of(service, caller, identifier)])[0]


def _views(service: Service, rows: Sequence[sa.RowMapping]) -> list[IntakeView]:
    views = jobs.views_of(service.database, [row["id"] for row in rows])
    return [IntakeView.model_validate({**row, "registered": row["folder"] is not None, "view": views.get(row["id"])}) for row in rows]


def begin_check(service: Service, caller: Caller, job: CheckJob, action: str) -> IntakeView:
    """Let a capture or environment take no more files while a job looks at it, or refuse the request; `action` is for the audit log."""
    intake = job.intake
    before = row_of(service, caller, intake)
    with audit.recorded(service.database, caller, action, intake) as connection:
        if not intakes.begin_check(connection, intake):
            raise ApiError("conflict", f"{intake} is {before['state']} already")
        if before["folder"] is None and uploads.count(connection, intake) == 0:
            raise ApiError("conflict", f"{intake} has no files yet: upload them first")
        if (file := uploads.unfinished(connection, intake)) is not None:
            raise ApiError("conflict", f"{intake}: {shown(file['path'])} is not complete: go on with {file['id']}, or delete it")
        submit(service, caller, job, connection, [intake])
    return _view(service, caller, intake)


def _routes(kind: str, a: str, prefix: str) -> APIRouter:
    """Return the routes that captures and environments have alike; `kind` is their word, `a` the same with its article."""
    router = APIRouter(prefix=f"/v1/{kind}s", tags=[f"{kind}s"], responses=responses(401, 403, 422, 429, 503), route_class=JsonRoute)
    one, is_id = f"/{{{kind}}}", pattern(prefix)

    @router.get("", name=f"list_{kind}s", summary=f"List {kind}s, the newest first", responses=responses(404),
                description=f"List the {kind}s of the project, one page at a time.")
    def list_intakes(service: ServiceDep, caller: Reader, limit: Limit = 100,
                     before: Annotated[str | None, Query(pattern=is_id)] = None) -> IntakePage:
        after = None if before is None else row_of(service, caller, before)
        rows = intakes.latest(service.database, caller.project, prefix, limit=limit + 1, before=after)
        return IntakePage(items=_views(service, rows[:limit]), next=rows[limit - 1]["id"] if len(rows) > limit else None)

    @router.get(one, name=f"get_{kind}", summary=f"Look at {a}", responses=responses(404),
                description=f"Return the state of {a} and the facts that its check found.")
    def get_intake(service: ServiceDep, caller: Reader, intake: Annotated[str, Path(alias=kind, pattern=is_id)]) -> IntakeView:
        return _view(service, caller, intake)

    @router.post(f"{one}/validate", name=f"validate_{kind}", status_code=202, summary=f"Check an uploaded {kind}",
                 responses=responses(404, 409, 507), description="Accept no more files, and check names, headers and, of a capture, the "
                 f"manifest; jobs may use the {kind} when it is ready.")
    def validate_intake(service: ServiceDep, caller: Writer, intake: Annotated[str, Path(alias=kind, pattern=is_id)]) -> IntakeView:
        return begin_check(service, caller, CheckJob(kind="check", intake=intake), "intake.validate")

    @router.delete(one, name=f"delete_{kind}", status_code=204, summary=f"Delete {a}", responses=responses(404, 409),
                   description=f"Delete {a} that no queued or running job reads; what was registered stays where it lies.")
    def delete_intake(service: ServiceDep, caller: Writer, intake: Annotated[str, Path(alias=kind, pattern=is_id)]) -> None:
        row = row_of(service, caller, intake)
        if row["state"] == states.CHECKING:
            raise ApiError("conflict", f"{intake} is being checked")
        with audit.recorded(service.database, caller, "intake.delete", intake) as connection:
            if users := jobs.users_of(connection, intake):
                raise ApiError("conflict", f"{intake} is read by {users[0]}, which has not ended")
            parts = intakes.remove(connection, intake)
        if parts is not None and row["folder"] is None:
            for upload in parts:
                service.parts.discard(upload)
            service.storage.remove(layout.intake(caller.project, intake))

    return router


captures, environments = _routes("capture", "a capture", CAPTURE), _routes("environment", "an environment", ENVIRONMENT)
samples = APIRouter(prefix="/v1/samples", tags=["captures"], responses=responses(401, 403, 422, 429, 503))


@captures.post("", status_code=201, responses=responses(404, 409, 507), summary="Create a capture")
def create_capture(service: ServiceDep, caller: Writer, response: Response, wanted: Annotated[NewCapture, Body(
        openapi_examples={"upload": {"value": {"name": "owl"}}, "register": {"value": {"name": "owl", "folder": "/captures/owl"}}})],
                   token: IdempotencyKey = None) -> IntakeView:
    """Create a capture, whose files are then uploaded; or register a folder of the server, which is checked at once."""
    folder = _registered(service, caller, "folder", wanted.folder, os.path.isdir)
    return _create(service, caller, CAPTURE, wanted.name, folder, token, response)


@samples.post("/captures", status_code=201, responses=responses(404, 409, 507), summary="Register the sample capture")
def register_sample(service: ServiceDep, caller: Writer, response: Response, token: IdempotencyKey = None) -> IntakeView:
    """Register the sample capture that comes with Relit, where it lies."""
    sample = _sample()
    return _create(service, caller, CAPTURE, sample.name, sample, token, response)


@samples.post("/environments", status_code=201, responses=responses(404, 409, 507), summary="Register the sample environment")
def register_sample_environment(service: ServiceDep, caller: Writer, response: Response, token: IdempotencyKey = None) -> IntakeView:
    """Register the environment that comes with the sample capture, where it lies."""
    sky = _sample() / "environment.exr"
    return _create(service, caller, ENVIRONMENT, sky.name, sky, token, response)


@captures.get("/{capture}/annotations", responses=responses(404), summary="List the annotations of a capture", response_model_by_alias=True)
def list_annotations(service: ServiceDep, caller: Reader, capture: CaptureId) -> AnnotationPage:
    """Return the annotations of a capture as an AnnotationPage (W3C), which `relit publish --annotations` takes as a file."""
    row_of(service, caller, capture)
    return page_of(capture, intakes.annotations_of(service.database, capture))


@captures.post("/{capture}/annotations", status_code=201, responses=responses(404, 409), summary="Annotate a capture")
def create_annotation(service: ServiceDep, caller: Writer, capture: CaptureId, wanted: Annotated[
        NewAnnotation, StrictJson(NewAnnotation), Body(openapi_examples={"point": {"value": {
            "body": {"type": "TextualBody", "value": "A repair"},
            "target": {"selector": {"type": "PointSelector", "x": 31, "y": 64}}}}})], response: Response) -> AnnotationView:
    """Keep a text about a point or a rectangle of the image with a capture."""
    width, height = ((row_of(service, caller, capture)["facts"] or {}).get("resolution") or (float("inf"), float("inf")))[:2]
    x, y, across, down = wanted.box()
    if x + across > width or y + down > height:
        raise ApiError("invalid", f"target: lies outside the image, which has {width}x{height} pixels")
    with service.database.begin() as connection:
        row = intakes.annotate(connection, capture, wanted.model_dump(mode="json"))
        if row is None:
            raise ApiError("conflict", f"{capture} has {intakes.MOST_ANNOTATIONS} annotations already: delete one first")
        audit.record(connection, caller, "annotation.create", row["id"])
    made = view_of(capture, row)
    response.headers["Location"] = made.id
    return made


@captures.delete("/{capture}/annotations/{annotation}", status_code=204, responses=responses(404), summary="Delete an annotation")
def delete_annotation(service: ServiceDep, caller: Writer, capture: CaptureId, annotation: AnnotationId) -> None:
    """Delete an annotation of a capture."""
    row_of(service, caller, capture)
    with audit.recorded(service.database, caller, "annotation.delete", annotation) as connection:
        if not intakes.remove_annotation(connection, capture, annotation):
            raise ApiError("not-found", f"there is no {annotation} of {capture}")


@environments.post("", status_code=201, responses=responses(404, 409, 507), summary="Create an environment")
def create_environment(service: ServiceDep, caller: Writer, response: Response, wanted: Annotated[NewEnvironment, Body(
        openapi_examples={"upload": {"value": {"name": "sky"}}, "register": {"value": {"name": "sky", "file": "/hdr/sky.exr"}}})],
                       token: IdempotencyKey = None) -> IntakeView:
    """Create an environment, whose one lat-long image is then uploaded; or register a file of the server, which is checked at once."""
    file = _registered(service, caller, "file", wanted.file, os.path.isfile)
    return _create(service, caller, ENVIRONMENT, wanted.name, file, token, response)


def _sample() -> FilePath:
    try:
        return sample_folder()
    except RequestError:
        raise ApiError("not-found", "this server was installed without the sample capture") from None


def _registered(service: Service, caller: Caller, field: str, given: str | None, exists: Callable[[FilePath], bool]) -> FilePath | None:
    """Return the folder or file of the server that is to be registered, or refuse the request; None: nothing is."""
    if given is None:
        return None
    if not caller.may(Scope.ADMIN):
        raise ApiError("forbidden", f"{field}: the key has the scope {caller.scope}, to register what lies on the server needs admin")
    path = FilePath(given)
    if not path.is_absolute() or ".." in path.parts:
        raise ApiError("invalid", f"{field}: give an absolute path of the server, without ..")
    place = resolved(path)
    if place is None or not any(place.is_relative_to(root) for root in service.settings.roots_of(caller.project)):
        raise ApiError("invalid", f"{field}: lies in none of the folders that the operator allows")
    if not exists(place):
        raise ApiError("invalid", f"{field}: there is no such {field}")
    return place


def _create(service: Service, caller: Caller, prefix: str, name: str, folder: FilePath | None, token: str | None,
            response: Response) -> IntakeView:
    service.limiter.take(caller.key, CREATION_COST - 1)  # as a request it has taken one token already
    require_space(service, FOR_WORK)

    def make(connection: sa.Connection) -> str:
        quotas.require(connection, service.settings, quotas.CAPTURES, caller.project, 1)
        identifier = intakes.insert(connection, project=caller.project, kind=prefix, name=name, folder=folder)
        if folder is not None:
            submit(service, caller, CheckJob(kind="check", intake=identifier), connection, [identifier])
        audit.record(connection, caller, "intake.create" if folder is None else "intake.register", identifier)
        return identifier

    asked = [prefix, name, None if folder is None else str(folder)]
    identifier = idempotency.create_once(service.database, caller.project, token, asked, make)
    response.headers["Location"] = f"/v1/{layout.FOLDERS[prefix]}/{identifier}"
    return _view(service, caller, identifier)
