"""Routes of results and of small pictures of them, and downloads of them and of environments, whole or in part (RFC 9110: ETag,
preconditions, one range).

A file is opened once, so that its ETag, its size and its bytes are those of one file, whatever replaces it meanwhile. Starlette's
FileResponse does not keep that: it opens the path again to send it, and takes a Last-Modified of the same second for the same file. It
also has no preconditions, answers an unreadable Range with 400 instead of the file, and 416 without a problem document.
"""

import os
import re
from collections.abc import AsyncIterator, Iterator
from contextlib import ExitStack
from email.utils import formatdate
from pathlib import Path as FilePath
from pathlib import PurePosixPath
from typing import Annotated, Any
from urllib.parse import quote

import anyio.to_thread
from fastapi import APIRouter, Depends, Header, Path, Query, Request, Response
from fastapi.responses import StreamingResponse

from service.requests.answers import ResultPage, ResultView
from service.requests.base.identifiers import EnvironmentId
from service.requests.export import FORMATS
from service.requests.states import READY
from service.server.api.context import Reader, ServiceDep
from service.server.api.intakes import row_of
from service.server.api.jobs import JobName, view
from service.server.api.problems import ApiError, responses
from service.server.base.safe_names import NameFault, check_path
from service.server.storage import layout
from service.server.storage.folder import OpenFile
from stage import inputs
from stage.errors import StageError

router = APIRouter(prefix="/v1/jobs/{job}/results", tags=["results"], responses=responses(401, 403, 404, 422, 429, 503))
environments = APIRouter(prefix="/v1/environments", tags=["environments"], responses=responses(401, 403, 404, 409, 422, 429, 503))

MAX_PAGE = 1000
PIECE_BYTES = 1 << 20
"""Bytes that are read and sent at once."""
MEDIA_TYPES = {".exr": "image/x-exr", ".json": "application/json", ".png": "image/png", ".jpg": "image/jpeg",
               **{f".{name}": facts.media_type for name, facts in FORMATS.items() if facts.media_type is not None}}
BYTES = "application/octet-stream"
CONTENT: dict[str, Any] = {kind: {"schema": {} if kind == "application/json" else {"type": "string", "format": "binary"}}
                           for kind in (*sorted(MEDIA_TYPES.values()), BYTES)}
DOWNLOAD: dict[int | str, dict[str, Any]] = {
    200: {"description": "The file.", "content": CONTENT},
    206: {"description": "The part that Range names.", "content": CONTENT},
    304: {"description": "If-None-Match names the file as it is."},
    **responses(412, 416),
}
TAG = re.compile(r'(W/)?("[\x21\x23-\x7e\x80-\xff]*")')
RANGE = re.compile(r"\s*bytes\s*=\s*(?:([0-9]{1,18})-([0-9]{0,18})|-([0-9]{1,18}))\s*", re.IGNORECASE)
Wanted = Annotated[str | None, Header(alias="Range", description="bytes=0-99; for several ranges at once the whole file is sent.")]
IfRange = Annotated[str | None, Header(description="The entity tag that Range is meant for.")]
Name = Annotated[str, Path(description="As the listing has it.", examples=["maps.exr"])]
Tags = Annotated[str | None, Header(description="Entity tags, or *.")]


def opened(service: ServiceDep, caller: Reader, request: Request, job: JobName, name: Name) -> Iterator[OpenFile]:
    """Open a result until the answer has been sent, or refuse the request."""
    view(service, caller, job)
    nothing = ApiError("not-found", f"{job} has no such result")
    try:
        check_path(name)
    except NameFault:
        raise nothing from None
    if not request.scope["path"].endswith(f"/{name}"):  # the router drops a line break at the end
        raise nothing
    file = service.storage.open(layout.results(caller.project, job), name)
    if file is None:
        raise nothing
    try:
        yield file
    finally:
        os.close(file.descriptor)


def opened_environment(service: ServiceDep, caller: Reader, environment: EnvironmentId) -> Iterator[OpenFile]:
    """Open the image of an environment until the answer has been sent, or refuse the request."""
    row = row_of(service, caller, environment)
    if row["state"] != READY:
        raise ApiError("conflict", f"{environment} is {row['state']}, not ready")
    gone = ApiError("not-found", f"the file of {environment} is not there any more")
    with ExitStack() as held:
        if row["folder"] is None:
            prefix = layout.intake(caller.project, environment)
            names = [found.name for found in service.storage.files(prefix)]
            file = service.storage.open(prefix, names[0]) if len(names) == 1 else None
            if file is None:
                raise gone
            held.callback(os.close, file.descriptor)
        else:
            path = FilePath(row["folder"])
            root = next((root for root in service.settings.roots_of(caller.project) if path.is_relative_to(root)), None)
            if root is None:
                raise gone
            try:
                held.enter_context(inputs.confined(path.parent, root))
                image = held.enter_context(inputs.opened(path)).file
            except StageError:
                raise gone from None
            file = OpenFile.of(path.name, image.fileno())
        yield file


@router.get("", summary="List the results of a job")
def list_results(service: ServiceDep, caller: Reader, job: JobName,
                 limit: Annotated[int, Query(ge=1, le=MAX_PAGE)] = MAX_PAGE,
                 after: Annotated[str | None, Query(description="`next` of the page before.")] = None) -> ResultPage:
    """List the files by name, one page at a time; of a running job, the complete ones."""
    view(service, caller, job)
    files = [file for file in service.storage.files(layout.results(caller.project, job)) if after is None or file.name > after]
    return ResultPage(results=[ResultView.model_validate({**file._asdict(), "url": f"/v1/jobs/{job}/results/{quote(file.name)}"})
                               for file in files[:limit]],
                      next=files[limit - 1].name if len(files) > limit else None)


@router.get("/{name:path}", responses=DOWNLOAD, response_class=Response, summary="Download a result")
async def download_result(file: Annotated[OpenFile, Depends(opened)], if_match: Tags = None, if_none_match: Tags = None,
                          wanted: Wanted = None, if_range: IfRange = None) -> Response:
    """Send a file, or a part of it. Under one ETag a file never changes, so that an interrupted download can be continued."""
    headers = headers_of(file)
    if unchanged(file, if_match, if_none_match):
        return Response(status_code=304, headers=headers)
    part = asked_range(wanted or "", file) if if_range is None or if_range == _etag(file) else None
    if part is not None:
        headers["Content-Range"] = f"bytes {part.start}-{part.stop - 1}/{file.size}"
    sent = range(file.size) if part is None else part
    return StreamingResponse(_body(file.descriptor, sent), 200 if part is None else 206, headers | {"Content-Length": str(len(sent))},
                             _media_type(file))


@router.head("/{name:path}", responses={200: DOWNLOAD[200], 304: DOWNLOAD[304], 412: DOWNLOAD[412]}, response_class=Response,
             summary="Size and ETag of a result")
async def head_result(file: Annotated[OpenFile, Depends(opened)], if_match: Tags = None, if_none_match: Tags = None) -> Response:
    """Send the headers of a download, without the file."""
    headers = headers_of(file)
    if unchanged(file, if_match, if_none_match):
        return Response(status_code=304, headers=headers)
    return Response(headers=headers | {"Content-Length": str(file.size)}, media_type=_media_type(file))


@environments.get("/{environment}/file", responses=DOWNLOAD, response_class=Response, summary="Download the image of an environment")
async def download_environment(file: Annotated[OpenFile, Depends(opened_environment)], if_match: Tags = None, if_none_match: Tags = None,
                               wanted: Wanted = None, if_range: IfRange = None) -> Response:
    """Send the image of an environment that is ready, or a part of it."""
    return await download_result(file, if_match, if_none_match, wanted, if_range)


def unchanged(file: OpenFile, if_match: str | None, if_none_match: str | None) -> bool:
    """Return whether the asker has a file already; refuse the request where it is for another than the file is now."""
    if if_match is not None and not tag_matches(if_match, _etag(file), strong=True):
        raise ApiError("precondition-failed", f"{file.name} is another now: its ETag is {_etag(file)}", headers={"ETag": _etag(file)})
    return if_none_match is not None and tag_matches(if_none_match, _etag(file), strong=False)


def tag_matches(header: str, etag: str, *, strong: bool) -> bool:
    """Return whether a list of entity tags contains `etag` or is *; with `strong`, weak tags do not count (RFC 9110, 13.1)."""
    return header.strip() == "*" or any(tag == etag and not (weak and strong) for weak, tag in TAG.findall(header))


def asked_range(header: str, file: OpenFile) -> range | None:
    """Return the bytes that a Range header names; None where it is malformed or names several, which may be ignored (RFC 9110, 14.2)."""
    found = RANGE.fullmatch(header)
    if found is None:
        return None
    first, last, suffix = found.groups()
    if last and int(last) < int(first):
        return None
    part = range(max(0, file.size - int(suffix)), file.size) if suffix else range(
        int(first), min(file.size, int(last) + 1 if last else file.size))
    if not part:
        raise ApiError("range-not-satisfiable", f"{file.name} has {file.size} bytes, and {header} asks for none of them",
                       headers={"Content-Range": f"bytes */{file.size}"})
    return part


def _etag(file: OpenFile) -> str:
    return f'"{file.version}"'


def headers_of(file: OpenFile) -> dict[str, str]:
    """Return the headers of an answer with a file."""
    name = PurePosixPath(file.name).name
    plain = f'filename="{name}"' if name.isascii() else f"filename*=UTF-8''{quote(name)}"
    return {"ETag": _etag(file), "Last-Modified": formatdate(file.modified_at, usegmt=True), "Accept-Ranges": "bytes",
            "Cache-Control": "private, no-cache", "Content-Disposition": f"attachment; {plain}", "X-Content-Type-Options": "nosniff"}


def _media_type(file: OpenFile) -> str:
    return MEDIA_TYPES.get(PurePosixPath(file.name).suffix.lower(), BYTES)


async def _body(descriptor: int, part: range) -> AsyncIterator[bytes]:
    at = part.start
    while at < part.stop:
        read = await anyio.to_thread.run_sync(os.pread, descriptor, min(PIECE_BYTES, part.stop - at), at)
        if not read:
            raise OSError("a result became shorter while it was sent")
        at += len(read)
        yield read


pictures = APIRouter(prefix="/v1/jobs/{job}/pictures", tags=["results"], responses=responses(401, 403, 404, 412, 422, 429, 503))
JPEG: dict[int | str, dict[str, Any]] = {200: {"description": "The picture.", "content": {"image/jpeg": {
    "schema": {"type": "string", "format": "binary"}}}}, 304: {"description": "If-None-Match names the file as it is."}}
one_at_a_time = anyio.CapacityLimiter(1)
"""Held while a file is decoded, so that a player asks for the memory of one; those that wait hold no thread of other requests."""


@pictures.get("/{name:path}", responses=JPEG, response_class=Response, summary="See a small picture of a result")
async def result_picture(file: Annotated[OpenFile, Depends(opened)], if_match: Tags = None, if_none_match: Tags = None) -> Response:
    """Send an EXR file as a JPEG of at most 512 × 512 pixels: linear light clipped and encoded as sRGB, over a neutral grey."""
    headers = headers_of(file) | {"Content-Disposition": "inline"}
    del headers["Accept-Ranges"]
    if unchanged(file, if_match, if_none_match):
        return Response(status_code=304, headers=headers)
    if not file.name.lower().endswith(".exr"):
        raise ApiError("invalid", f"{file.name} is no EXR file, of which there are pictures")
    try:
        picture = await anyio.to_thread.run_sync(_picture, FilePath(f"/proc/self/fd/{file.descriptor}"), limiter=one_at_a_time)
    except (StageError, ValueError) as error:
        raise ApiError("invalid", f"{file.name} cannot be shown: damaged, too large, or without colours of a known space") from error
    return Response(picture, media_type="image/jpeg", headers=headers)


def _picture(path: FilePath) -> bytes:
    from stage.results.small_picture import small_picture  # which loads NumPy

    return small_picture(path)
