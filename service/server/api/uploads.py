"""Routes of uploads: files of captures and environments, by tus 1.0 with creation, checksum, expiration and termination."""

import asyncio
import time
from contextlib import closing
from typing import Annotated, Any

import sqlalchemy as sa
from fastapi import APIRouter, Header, Path, Query, Request, Response

from service.requests.answers import FilePage, FileView
from service.requests.base.identifiers import CAPTURE, ENVIRONMENT, UploadId, pattern
from service.server.api import tus
from service.server.api.context import FOR_UPLOAD, IdempotencyKey, Reader, Service, ServiceDep, Writer, require_space
from service.server.api.intakes import row_of
from service.server.api.problems import ApiError, found_in_project, responses
from service.server.api.upload_patch import UploadPatch, being_written, received_of, settled, too_long
from service.server.base.safe_names import check_path, shown
from service.server.database import audit, idempotency, intakes, quotas, uploads
from service.server.database.keys import Caller
from service.server.database.uploads import Row
from service.server.storage import layout
from service.server.storage.upload_parts import PartFileLocked

router = APIRouter(prefix="/v1", tags=["uploads"], responses=responses(401, 403, 404, 412, 422, 429, 503), dependencies=[tus.Speaking])
listings = APIRouter(prefix="/v1", tags=["uploads"], responses=responses(401, 403, 404, 422, 429, 503))
options = APIRouter(prefix="/v1", tags=["uploads"])
BREAK_S, LOOK_S = 2.0, 0.02
"""Seconds for which HEAD waits for a PATCH to end, and between two looks: a client may ask before its broken connection is noticed here."""

UploadLength = Annotated[int, Header(alias="Upload-Length", ge=0, description="Length of the file, bytes.")]
UploadMetadata = Annotated[str, Header(
    alias="Upload-Metadata", max_length=4096, description="`path` and the name within the capture in base64; then, if you like, a comma, "
    "`sha256` and its 64 hexadecimal digits in base64.",
    openapi_examples={"one": {"value": "path MDAwLmV4cg=="}, "within a folder": {"value": "path c3RlcDEvMDAwLmV4cg=="}})]
Limit = Annotated[int, Query(ge=1, le=5000)]
After = Annotated[str | None, Query(max_length=4096, pattern=r"^[^\x00]*$")]
CREATED: dict[int | str, dict[str, Any]] = {
    201: {"description": "Created", "headers": tus.documented("Location", "Upload-Offset", "Upload-Expires")}, **responses(409, 413, 507)}


@options.options("/uploads", status_code=204, summary="What the server supports of tus",
                 responses={204: {"headers": tus.documented("Tus-Version", "Tus-Extension", "Tus-Max-Size", "Tus-Checksum-Algorithm")}})
@options.options("/uploads/{upload}", status_code=204, include_in_schema=False)
@options.options("/captures/{capture}/files", status_code=204, include_in_schema=False)
@options.options("/environments/{environment}/files", status_code=204, include_in_schema=False)
def abilities(service: ServiceDep, response: Response) -> None:
    """Return version, extensions and limits."""
    response.headers.update({"Tus-Version": tus.VERSION, "Tus-Extension": ",".join(tus.EXTENSIONS),
                             "Tus-Checksum-Algorithm": ",".join(tus.ALGORITHMS),
                             "Tus-Max-Size": str(service.settings.max_upload_bytes)})


def _file_routes(kind: str, a: str, prefix: str) -> None:
    """Add the routes of the files of captures or environments; `kind` is their word, `a` the same with its article."""
    path, is_id = f"/{kind}s/{{{kind}}}/files", pattern(prefix)

    @router.post(path, name=f"create_{kind}_file", status_code=201, responses=CREATED, summary=f"Begin to upload a file of {a}",
                 description=f"Create an upload; its file replaces a complete one of the same path, while the {kind} is receiving or "
                 "refused.")
    def create_file(service: ServiceDep, caller: Writer, response: Response, intake: Annotated[str, Path(alias=kind, pattern=is_id)],
                    length: UploadLength, metadata: UploadMetadata, token: IdempotencyKey = None) -> FileView:
        return _create(service, caller, intake, length, tus.Metadata.of(metadata), token, response)

    @listings.get(path, name=f"list_{kind}_files", summary=f"List the files of {a}",
                  description=f"List the uploaded files, complete or not; a registered {kind} has none.")
    def list_files(service: ServiceDep, caller: Reader, intake: Annotated[str, Path(alias=kind, pattern=is_id)], limit: Limit = 1000,
                   after: After = None) -> FilePage:
        row_of(service, caller, intake)
        rows = uploads.listing(service.database, intake, limit=limit + 1, after=after)
        files = [_file_view(service, row) for row in rows[:limit]]
        return FilePage(files=files, next=files[-1].path if len(rows) > limit else None)


_file_routes("capture", "a capture", CAPTURE)
_file_routes("environment", "an environment", ENVIRONMENT)


@router.head("/uploads/{upload}", response_class=Response, summary="Look at an upload", responses={
    200: {"headers": tus.documented("Upload-Offset", "Upload-Length", "Upload-Metadata")}, **responses(410)})
async def head_upload(service: ServiceDep, caller: Reader, upload: UploadId) -> Response:
    """Return Upload-Offset: the number of bytes that are safe, where the upload is to be continued."""
    deadline = time.monotonic() + BREAK_S
    while upload in being_written and time.monotonic() < deadline:
        await asyncio.sleep(LOOK_S)
    row = await asyncio.to_thread(_row, service, caller, upload)
    received = await asyncio.to_thread(received_of, service, row)
    return Response(headers={**tus.state_headers(row, received, service.settings.upload_hours),
                             "Upload-Length": str(row["length"]), "Upload-Metadata": tus.metadata_header(row)})


@router.patch("/uploads/{upload}", status_code=204, summary="Continue an upload", openapi_extra={
    "requestBody": {"required": True, "content": {tus.CONTENT_TYPE: {"schema": {"type": "string", "format": "binary"}}}}},
    responses={204: {"headers": tus.documented("Upload-Offset", "Upload-Expires")}, **responses(400, 409, 410, 413, 415, 423, 460, 507)})
async def patch_upload(
    service: ServiceDep, caller: Writer, request: Request, response: Response, upload: UploadId,
    offset: Annotated[int, Header(alias="Upload-Offset", ge=0, description="Offset of the body: the number of bytes that the server has.")],
    checksum: Annotated[str | None, Header(
        alias="Upload-Checksum", json_schema_extra={"pattern": tus.CHECKSUM_PATTERN},
        description="`sha1` or `sha256`, a space, and the digest of the body in base64: a body with another digest is dropped.",
        openapi_examples={"none": {"value": "sha1 2jmj7l5rSw0yVb/vlWAYkK/YBwk="}})] = None,
) -> None:
    """Append the body to the upload. The last byte completes the file, which is then in the capture."""
    if request.headers.get("content-type", "").partition(";")[0].strip().lower() != tus.CONTENT_TYPE:
        raise ApiError("unsupported-media-type", f"Content-Type: give {tus.CONTENT_TYPE}")
    expected = None if checksum is None else tus.Checksum.of(checksum)
    row: Row = await asyncio.to_thread(_row, service, caller, upload)
    announced = request.headers.get("content-length", "0")
    if announced.isdigit() and offset + int(announced) > row["length"]:
        raise too_long(row)
    with closing(await asyncio.to_thread(UploadPatch, service, caller, row, offset=offset, checksum=expected)) as patch:
        try:
            broken = await patch.write(request.stream())
        except Exception:
            await asyncio.to_thread(patch.give_up)
            raise
        row = await asyncio.to_thread(patch.end, broken)
    response.headers.update(tus.state_headers(row, row["received"], service.settings.upload_hours))


@router.delete("/uploads/{upload}", status_code=204, responses=responses(409, 410, 423), summary="Delete an upload")
def delete_upload(service: ServiceDep, caller: Writer, upload: UploadId) -> None:
    """Delete an upload; or delete a complete file from a capture that is receiving or refused."""
    row = _row(service, caller, upload)
    try:
        part = service.parts.open(row)
    except PartFileLocked:
        raise ApiError("locked", f"{upload}: a request is adding to it", headers={"Retry-After": "1"}) from None
    with closing(part):
        try:
            with service.database.begin() as connection:
                _hold(service, caller, connection, row["intake"])
                if uploads.remove(connection, upload):
                    audit.record(connection, caller, "upload.delete", upload)
                    service.storage.delete(layout.intake(row["project"], row["intake"]), row["path"])
        finally:
            if row["done"] or uploads.find(service.database, upload, caller.project) is None:
                part.drop()


def _create(service: Service, caller: Caller, intake: str, length: int, given: tus.Metadata, token: str | None, response: Response,
            ) -> FileView:
    settings = service.settings
    row_of(service, caller, intake)
    check_path(given.path)
    if length > settings.max_upload_bytes:
        raise ApiError("too-large", f"Upload-Length: is {length}, a file may have {settings.max_upload_bytes} bytes")
    require_space(service, FOR_UPLOAD, length)

    def make(connection: sa.Connection) -> str:
        _hold(service, caller, connection, intake)
        before = uploads.at_path(connection, intake, given.path)
        if before is not None and (before["done"] or _expired(service, before)):
            uploads.remove(connection, before["id"])  # the part file of an expired one goes with the next housekeeping
        elif before is not None:
            raise ApiError("conflict", f"path {shown(given.path)}: is being uploaded as {before['id']}: go on with it, or delete it")
        count, most = uploads.count(connection, intake), settings.max_capture_files
        if intake.startswith(ENVIRONMENT) and count > 0:
            raise ApiError("conflict", f"{intake} has its file already: delete that, or give its path to replace it")
        if count >= most:
            raise ApiError("too-large", f"{intake} has {count} files, and more than {most} are not taken")
        quotas.require(connection, service.settings, quotas.BYTES, caller.project, length)
        try:
            identifier = uploads.insert(connection, project=caller.project, intake=intake, path=given.path, length=length,
                                        sha256=given.sha256)
        except uploads.PathTaken as error:
            raise ApiError("conflict", str(error)) from None
        audit.record(connection, caller, "upload.create", identifier)
        if before is not None and before["done"]:  # when nothing can refuse the request any more
            service.storage.delete(layout.intake(caller.project, intake), given.path)
        return identifier

    asked = ["upload", intake, given.path, length, given.sha256]
    upload = idempotency.create_once(service.database, caller.project, token, asked, make)
    row = uploads.find(service.database, upload, caller.project)
    if token is not None and (row is None or _expired(service, row)):  # or deleted or replaced since: the same request makes another
        with service.database.begin() as connection:
            idempotency.forget_token(connection, caller.project, token, gone=upload)
        upload = idempotency.create_once(service.database, caller.project, token, asked, make)
        row = uploads.find(service.database, upload, caller.project)
    if row is None:
        raise ApiError("conflict", f"{upload}: was deleted at the same time")
    if length == 0 and not row["done"]:
        with closing(UploadPatch(service, caller, row, offset=0, checksum=None)) as patch:
            row = patch.end(None)
    view = _file_view(service, row)
    response.headers.update({"Location": f"/v1/uploads/{upload}", **tus.state_headers(row, view.received, service.settings.upload_hours)})
    return view


def _file_view(service: Service, row: Row) -> FileView:
    return FileView(upload=row["id"], path=row["path"], length=row["length"], received=received_of(service, row), done=row["done"],
                    sha256=row["sha256"])


def _hold(service: Service, caller: Caller, connection: sa.Connection, intake: str) -> None:
    if intakes.lock_for_files(connection, intake, caller.project):
        return
    row = row_of(service, caller, intake)
    state = "registered" if row["folder"] is not None else row["state"]
    raise ApiError("conflict", f"{intake} is {state}: its files do not change any more")


def _row(service: Service, caller: Caller, upload: str) -> Row:
    row = settled(service, found_in_project(uploads.find(service.database, upload, caller.project), upload))
    if _expired(service, row):
        raise ApiError("gone", f"{upload}: nothing came for {service.settings.upload_hours:g} hours: begin it again")
    return row


def _expired(service: Service, row: Row) -> bool:
    return not row["done"] and tus.expires_at(row, service.settings.upload_hours) < time.time()
