"""Routes of captures and environments: create for an upload, or register where they lie on the server; check, list, delete."""

import os
from pathlib import Path
from typing import Annotated

import sqlalchemy as sa
from fastapi import APIRouter, Body, Query, Response
from pydantic import BaseModel, ConfigDict, Field

from service.requests.base.identifiers import CAPTURE, ENVIRONMENT, CaptureId, EnvironmentId, new_id
from service.requests.jobs import CheckJob
from service.requests.keys import Scope
from service.requests.views import states
from service.requests.views.intakes import IntakePage, IntakeView
from service.server.api.context import FOR_WORK, IdempotencyKey, Reader, Service, ServiceDep, Writer, require_space
from service.server.api.json_body import JsonRoute
from service.server.api.limits import CREATION_COST
from service.server.api.problems import ApiError, responses
from service.server.api.submission import submit
from service.server.api.views import intake_view
from service.server.base.safe_names import shown
from service.server.database import audit, idempotency, intakes, jobs, quotas, uploads
from service.server.database.keys import Caller
from service.server.storage import layout
from stage.files import resolved
from stage.model import Line

captures = APIRouter(prefix="/v1/captures", tags=["captures"], responses=responses(401, 403, 422, 429, 503), route_class=JsonRoute)
environments = APIRouter(prefix="/v1/environments", tags=["environments"], responses=responses(401, 403, 422, 429, 503),
                         route_class=JsonRoute)

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


@captures.post("", status_code=201, responses=responses(404, 409, 507), summary="Create a capture")
def create_capture(service: ServiceDep, caller: Writer, response: Response, wanted: Annotated[NewCapture, Body(
        openapi_examples={"upload": {"value": {"name": "owl"}}, "register": {"value": {"name": "owl", "folder": "/captures/owl"}}})],
                   token: IdempotencyKey = None) -> IntakeView:
    """Create a capture, whose files are then uploaded; or register a folder of the server, which is checked at once."""
    folder = None if wanted.folder is None else _registered(service, caller, "folder", wanted.folder)
    if folder is not None and not os.path.isdir(folder):
        raise ApiError("invalid", "folder: there is no such folder")
    return _create(service, caller, CAPTURE, wanted.name, folder, token, response)


@environments.post("", status_code=201, responses=responses(404, 409, 507), summary="Create an environment")
def create_environment(service: ServiceDep, caller: Writer, response: Response, wanted: Annotated[NewEnvironment, Body(
        openapi_examples={"upload": {"value": {"name": "sky"}}, "register": {"value": {"name": "sky", "file": "/hdr/sky.exr"}}})],
                       token: IdempotencyKey = None) -> IntakeView:
    """Create an environment, whose one lat-long image is then uploaded; or register a file of the server, which is checked at once."""
    file = None if wanted.file is None else _registered(service, caller, "file", wanted.file)
    if file is not None and not os.path.isfile(file):
        raise ApiError("invalid", "file: there is no such file")
    return _create(service, caller, ENVIRONMENT, wanted.name, file, token, response)


@captures.get("", responses=responses(404), summary="List captures, the newest first")
def list_captures(service: ServiceDep, caller: Reader, limit: Limit = 100, before: CaptureId | None = None) -> IntakePage:
    """List the captures of the project, one page at a time."""
    return _page(service, caller, CAPTURE, limit, before)


@environments.get("", responses=responses(404), summary="List environments, the newest first")
def list_environments(service: ServiceDep, caller: Reader, limit: Limit = 100, before: EnvironmentId | None = None) -> IntakePage:
    """List the environments of the project, one page at a time."""
    return _page(service, caller, ENVIRONMENT, limit, before)


@captures.get("/{capture}", responses=responses(404), summary="Look at a capture")
def get_capture(service: ServiceDep, caller: Reader, capture: CaptureId) -> IntakeView:
    """Return the state of a capture and the facts that its check found."""
    return intake_view(row_of(service, caller, capture))


@environments.get("/{environment}", responses=responses(404), summary="Look at an environment")
def get_environment(service: ServiceDep, caller: Reader, environment: EnvironmentId) -> IntakeView:
    """Return the state of an environment and the facts that its check found."""
    return intake_view(row_of(service, caller, environment))


@captures.post("/{capture}/validate", status_code=202, responses=responses(404, 409, 507), summary="Check an uploaded capture")
def validate_capture(service: ServiceDep, caller: Writer, capture: CaptureId) -> IntakeView:
    """Accept no more files, and check manifest, names and headers; jobs may use the capture when it is ready."""
    return _validate(service, caller, capture)


@environments.post("/{environment}/validate", status_code=202, responses=responses(404, 409, 507), summary="Check an uploaded environment")
def validate_environment(service: ServiceDep, caller: Writer, environment: EnvironmentId) -> IntakeView:
    """Accept no more files, and check the image's header; jobs may use the environment when it is ready."""
    return _validate(service, caller, environment)


@captures.delete("/{capture}", status_code=204, responses=responses(404, 409), summary="Delete a capture")
def delete_capture(service: ServiceDep, caller: Writer, capture: CaptureId) -> None:
    """Delete a capture that no queued or running job reads; a registered folder stays where it lies."""
    _delete(service, caller, capture)


@environments.delete("/{environment}", status_code=204, responses=responses(404, 409), summary="Delete an environment")
def delete_environment(service: ServiceDep, caller: Writer, environment: EnvironmentId) -> None:
    """Delete an environment that no queued or running job reads; a registered file stays where it lies."""
    _delete(service, caller, environment)


def row_of(service: Service, caller: Caller, identifier: str) -> sa.RowMapping:
    """Return the row of a capture or environment of the caller's project.

    Raises:
        ApiError: the project has no such capture or environment.
    """
    row = intakes.find(service.database, identifier, caller.project)
    if row is None:
        raise ApiError("not-found", f"there is no {identifier} in this project")
    return row


def _registered(service: Service, caller: Caller, field: str, given: str) -> Path:
    if not caller.may(Scope.ADMIN):
        raise ApiError("forbidden", f"{field}: the key has the scope {caller.scope}, to register what lies on the server needs admin")
    path = Path(given)
    if not path.is_absolute() or ".." in path.parts:
        raise ApiError("invalid", f"{field}: give an absolute path of the server, without ..")
    place = resolved(path)
    if place is None or not any(place.is_relative_to(root) for root in service.settings.roots_of(caller.project)):
        raise ApiError("invalid", f"{field}: lies in none of the folders that the operator allows")
    return place


def _create(service: Service, caller: Caller, prefix: str, name: str, folder: Path | None, token: str | None,
            response: Response) -> IntakeView:
    service.limiter.take(caller.key, CREATION_COST - 1)  # as a request it has taken one token already
    require_space(service, FOR_WORK)

    def make(connection: sa.Connection) -> str:
        identifier = new_id(prefix)
        quotas.require(connection, service.settings, quotas.CAPTURES, caller.project, 1)
        intakes.insert(connection, identifier=identifier, project=caller.project, kind=prefix, name=name,
                       folder=None if folder is None else str(folder))
        if folder is not None:
            submit(service, caller, CheckJob(kind="check", intake=identifier), connection, [identifier])
        audit.record(connection, caller, "intake.create" if folder is None else "intake.register", identifier)
        return identifier

    asked = [prefix, name, None if folder is None else str(folder)]
    identifier, _ = idempotency.create_once(service.database, caller.project, token, asked, make)
    response.headers["Location"] = f"/v1/{layout.FOLDERS[prefix]}/{identifier}"
    return intake_view(row_of(service, caller, identifier))


def _page(service: Service, caller: Caller, prefix: str, limit: int, before: str | None) -> IntakePage:
    after = None
    if before is not None:
        row = row_of(service, caller, before)
        after = row["created_at"], row["id"]
    rows = intakes.latest(service.database, caller.project, prefix, limit=limit + 1, before=after)
    return IntakePage(items=[intake_view(row) for row in rows[:limit]], next=rows[limit - 1]["id"] if len(rows) > limit else None)


def _validate(service: Service, caller: Caller, identifier: str) -> IntakeView:
    before = row_of(service, caller, identifier)

    def work(connection: sa.Connection) -> bool:
        if not intakes.begin_check(connection, identifier):
            return False
        if (file := uploads.unfinished(connection, identifier)) is not None:
            raise ApiError("conflict", f"{identifier}: {shown(file['path'])} is not complete: go on with {file['id']}, or delete it")
        submit(service, caller, CheckJob(kind="check", intake=identifier), connection, [identifier])
        audit.record(connection, caller, "intake.validate", identifier)
        return True

    if not service.database.transact(work):
        raise ApiError("conflict", f"{identifier} is {before['state']} already")
    return intake_view(row_of(service, caller, identifier))


def _delete(service: Service, caller: Caller, identifier: str) -> None:
    row = row_of(service, caller, identifier)
    if row["state"] == states.CHECKING:
        raise ApiError("conflict", f"{identifier} is being checked")

    def work(connection: sa.Connection) -> list[str] | None:
        if users := jobs.users_of(connection, identifier, active=True):
            raise ApiError("conflict", f"{identifier} is read by {users[0]}, which has not ended")
        audit.record(connection, caller, "intake.delete", identifier)
        return intakes.remove(connection, identifier)

    parts = service.database.transact(work)
    if parts is not None and row["folder"] is None:
        for upload in parts:
            service.parts.discard(upload)
        service.storage.remove(layout.intake(caller.project, identifier))
