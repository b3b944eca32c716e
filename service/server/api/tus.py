"""The headers of the tus 1.0 protocol (https://tus.io/protocols/resumable-upload)."""

import hashlib
import re
from base64 import b64decode, b64encode
from contextlib import suppress
from email.utils import formatdate
from typing import Annotated, Any, NamedTuple

from fastapi import Depends, Header
from starlette.datastructures import MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.server.api.problems import ApiError
from service.server.database.uploads import Row

VERSION = "1.0.0"
EXTENSIONS = ("creation", "expiration", "checksum", "termination")
ALGORITHMS = ("sha1", "sha256")
CONTENT_TYPE = "application/offset+octet-stream"
PLACES = re.compile(r"/v1/(uploads(/[^/]*)?|(captures|environments)/[^/]*/files)")
OVERRIDE = b"x-http-method-override"
OVERRIDES = (b"PATCH", b"DELETE", b"HEAD")
CHECKSUM_PATTERN = "^sha(1|256) [A-Za-z0-9+/]{27,43}=$"
"""Pattern of Upload-Checksum for the OpenAPI document only: the protocol has its own status for a malformed one."""
HEX_SHA256 = re.compile(r"[0-9a-f]{64}")
METADATA_KEYS = ("path", "sha256")


def _version(given: Annotated[str, Header(alias="Tus-Resumable", json_schema_extra={"enum": [VERSION]},
                                          description="Version of the tus protocol.")]) -> None:
    if given != VERSION:
        raise ApiError("precondition-failed", f"Tus-Resumable: is {given[:20]!r}, this server speaks {VERSION}",
                       headers={"Tus-Version": VERSION})


Speaking = Depends(_version)


class Checksum(NamedTuple):
    """The checksum of the body of one request."""

    algorithm: str
    digest: bytes

    @classmethod
    def of(cls, header: str) -> "Checksum":
        """Read an Upload-Checksum header, or refuse the request."""
        algorithm, _, text = header.partition(" ")
        if algorithm not in ALGORITHMS:
            raise ApiError("bad-request", f"Upload-Checksum: give {' or '.join(ALGORITHMS)}, a space, and the digest in base64")
        with suppress(ValueError):
            digest = b64decode(text, validate=True)
            if len(digest) == hashlib.new(algorithm).digest_size:
                return cls(algorithm, digest)
        raise ApiError("bad-request", f"Upload-Checksum: what follows {algorithm} is not its digest in base64")


class Metadata(NamedTuple):
    """Path and checksum of a file, as the client gives them."""

    path: str
    sha256: str | None

    @classmethod
    def of(cls, header: str) -> "Metadata":
        """Read an Upload-Metadata header, or refuse the request; whether the path is safe is not checked."""
        found: dict[str, str] = {}
        for pair in header.split(","):
            key, _, text = pair.strip().partition(" ")
            if key not in METADATA_KEYS:
                raise ApiError("invalid", f"Upload-Metadata: {key[:40]!a} is not a known key: give path and, if you like, sha256")
            if key in found:
                raise ApiError("invalid", f"Upload-Metadata: {key} is given twice")
            try:
                found[key] = b64decode(text, validate=True).decode()
            except ValueError:
                raise ApiError("invalid", f"Upload-Metadata: {key} is not UTF-8 text in base64") from None
        if "path" not in found:
            raise ApiError("invalid", "Upload-Metadata: path is missing: the name of the file within the capture, in base64")
        if "sha256" in found and not HEX_SHA256.fullmatch(found["sha256"]):
            raise ApiError("invalid", "Upload-Metadata: sha256 is not 64 hexadecimal digits in small letters, in base64")
        return cls(found["path"], found.get("sha256"))


def metadata_header(row: Row) -> str:
    """Return the Upload-Metadata of an upload, as it was given."""
    words = {key: row[key] for key in METADATA_KEYS if row[key] is not None}
    return ",".join(f"{key} {b64encode(word.encode()).decode()}" for key, word in words.items())


def state_headers(row: Row, received: int, upload_hours: float) -> dict[str, str]:
    """Return the headers that say how far an upload is, and how long it is kept as it is."""
    headers = {"Upload-Offset": str(received), "Cache-Control": "no-store"}
    if not row["done"]:
        headers["Upload-Expires"] = formatdate(expires_at(row, upload_hours), usegmt=True)
    return headers


def expires_at(row: Row, upload_hours: float) -> float:
    """Return when an incomplete upload is removed, in seconds since 1970."""
    return float(row["touched_at"]) + 3600 * upload_hours


class TusHeaders:
    """ASGI middleware: answers about uploads, refusals too, name the version of tus; a header may override the method."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, and add the version to its answer."""
        if scope["type"] != "http" or not PLACES.fullmatch(scope["path"]):
            await self._app(scope, receive, send)
            return
        if scope["method"] == "POST" and (method := dict(scope["headers"]).get(OVERRIDE)) in OVERRIDES:
            scope = {**scope, "method": method.decode()}

        async def tell(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message)["Tus-Resumable"] = VERSION
            await send(message)

        await self._app(scope, receive, tell)


def documented(*names: str) -> dict[str, Any]:
    """Return the headers of an answer for the OpenAPI document."""
    return {name: {"schema": {"type": "string"}} for name in ("Tus-Resumable", *names)}
