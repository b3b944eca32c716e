"""An object store, through obstore: lists, fetches in ranges, sends in parts and deletes objects; every error is one sentence.

The credentials, region and endpoint of S3 come from the usual variables (AWS_ACCESS_KEY_ID, AWS_REGION, AWS_ENDPOINT_URL …).
"""

import os
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from datetime import timedelta
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TypeVar
from urllib.parse import unquote, urlsplit

from service.errors import RequestError
from stage.errors import StorageError, storage

T = TypeVar("T")
PIECE_BYTES = PART_BYTES = 16 << 20
"""Bytes of one request: few enough for a slow line to send them within REQUEST_S, enough for the number of requests not to matter."""
MOST_PARTS = 9_000
"""Parts of an object at most; S3 accepts 10 000."""
PARTS_AT_ONCE = 2
"""Parts of one file that are sent at one time; several files are sent at one time."""
DELETED_AT_ONCE = 1000
CONNECT_S, REQUEST_S = 10, 120
RETRIES, RETRY_S = 100, 120
"""Retries, and their time in all, after errors of the network and of the store (5xx), with growing pauses; then the step fails."""
BROKEN, AGAIN_S = "HTTP error:", 0.5
"""The text in obstore's connection errors, after some of which it gives up at once (a damaged answer, a request cut while it is sent), and
the pause before another try."""
PROBE_RETRIES, PROBE_S = 1, 5
"""Retries and time of a check whether the store answers, for which somebody waits."""


class Object(NamedTuple):
    """An object of the store."""

    path: str
    size: int
    modified_at: float
    version: str
    """The ETag, which changes with the content."""


class Bucket:
    """The objects below a URL."""

    def __init__(self, url: str) -> None:
        """Create the bucket s3://bucket/prefix or file:///folder; the store is not asked anything."""
        self.url = url.rstrip("/")
        self._store = _store(url, retries=RETRIES, retry_s=RETRY_S, request_s=REQUEST_S)
        self._probe = _store(url, retries=PROBE_RETRIES, retry_s=PROBE_S, request_s=PROBE_S)
        import obstore  # which _store has found

        self._api: Any = obstore

    def below(self, prefix: str) -> list[Object]:
        """Return all objects whose path begins with the prefix and a /."""
        return self._call("list", prefix, lambda: [
            _object(meta) for batch in self._api.list(self._store, prefix=f"{prefix}/") for meta in batch])

    def find(self, path: str) -> Object | None:
        """Return one object; None: there is none."""
        from obstore.exceptions import GenericError

        def head() -> Object | None:
            try:
                return _object(self._api.head(self._store, path))
            except FileNotFoundError:
                return None
            except GenericError as error:
                if "Not a directory" in str(error):  # a name below a file, of a store of files
                    return None
                raise

        return self._call("look at", path, head)

    def fetch(self, found: Object, target: Path, moved: Callable[[], None]) -> None:
        """Copy an object, unless it was replaced meanwhile, into a file; `moved` is called after every piece and may raise to end it."""
        with storage("write", target), open(target, "wb") as file:
            for begin in range(0, found.size, PIECE_BYTES):
                end = min(begin + PIECE_BYTES, found.size)
                got = self._call("fetch", found.path, partial(self._piece, found, begin, end))
                if len(got) != end - begin:
                    raise StorageError(f"cannot fetch {self.url}/{found.path}: {len(got)} bytes came instead of {end - begin}")
                file.write(got)
                moved()

    def _piece(self, found: Object, begin: int, end: int) -> Any:
        return self._api.get(self._store, found.path, options={"if_match": found.version, "range": (begin, end)}).bytes()

    def send(self, file: Path, path: str, moved: Callable[[], None]) -> Object:
        """Copy a file into an object, which appears complete or not at all; `moved` is that of `fetch`."""
        with storage("read", file), open(file, "rb") as source:
            size = os.fstat(source.fileno()).st_size
            part = max(PART_BYTES, -(-size // MOST_PARTS))

            def put() -> None:
                source.seek(0)
                if size <= part:
                    self._api.put(self._store, path, source.read(), use_multipart=False)
                    moved()
                else:
                    self._api.put(self._store, path, _parts(source, part, moved), chunk_size=part, max_concurrency=PARTS_AT_ONCE)

            self._call("send", path, put)
        sent = self.find(path)
        if sent is None or sent.size != size:
            raise StorageError(f"cannot send {self.url}/{path}: it is not there as it was sent")
        return sent

    def mark(self, path: str) -> None:
        """Write an empty object."""
        self._call("write", path, lambda: self._api.put(self._store, path, b"", use_multipart=False))

    def delete(self, paths: list[str]) -> None:
        """Delete objects; some may be gone already."""
        for begin in range(0, len(paths), DELETED_AT_ONCE):
            self._call("delete", paths[begin], partial(self._delete_all, paths[begin : begin + DELETED_AT_ONCE]))

    def _delete_all(self, paths: list[str]) -> None:
        try:
            self._api.delete(self._store, paths)
        except FileNotFoundError:  # of a store of files, which stops at a missing one: one at a time then
            for path in paths:
                with suppress(FileNotFoundError):
                    self._api.delete(self._store, path)

    def check(self, path: str) -> None:
        """Write and delete an object, with few retries."""
        def probe() -> None:
            self._api.put(self._probe, path, b"relit", use_multipart=False)
            with suppress(FileNotFoundError):
                self._api.delete(self._probe, path)

        self._call("write", path, probe, within_s=0.0)

    def _call(self, action: str, path: str, ask: Callable[[], T], within_s: float = RETRY_S) -> T:
        """Call obstore, and again after errors of the connection that it does not retry; other exceptions become one sentence."""
        from obstore.exceptions import BaseError, GenericError

        until = time.monotonic() + within_s
        while True:
            try:
                return ask()
            except (StorageError, FileNotFoundError):
                raise
            except (BaseError, OSError, ValueError) as error:
                if not isinstance(error, GenericError) or BROKEN not in str(error) or time.monotonic() > until:
                    raise StorageError(f"cannot {action} {self.url}/{path}: {_reason(error)}") from error
            time.sleep(AGAIN_S)


def _store(url: str, *, retries: int, retry_s: int, request_s: int) -> Any:
    try:
        from obstore.exceptions import BaseError
        from obstore.store import LocalStore, S3Store
    except ModuleNotFoundError:
        raise RequestError(f"storage_url {url}: needs obstore: install relit[s3]") from None
    parts = urlsplit(url)
    if parts.scheme == "file" and not parts.netloc and parts.path not in ("", "/"):
        folder = Path(unquote(parts.path))
        with storage("make", folder):
            folder.mkdir(parents=True, exist_ok=True)
        return LocalStore(folder)
    if parts.scheme != "s3" or not parts.netloc or parts.query or parts.fragment or "@" in parts.netloc:
        raise RequestError("storage_url: give s3://bucket/prefix or file:///folder; keys of the store come from AWS_… in the environment")
    clear = os.environ.get("AWS_ALLOW_HTTP", "").lower() in ("1", "true")
    endpoint = os.environ.get("AWS_ENDPOINT_URL_S3") or os.environ.get("AWS_ENDPOINT_URL") or os.environ.get("AWS_ENDPOINT") or ""
    if endpoint.startswith("http://") and not clear:
        raise RequestError(f"AWS_ENDPOINT_URL {endpoint}: sends images in the clear: give https://, or allow it by AWS_ALLOW_HTTP=true")
    try:
        return S3Store.from_url(
            url, client_options={"connect_timeout": timedelta(seconds=CONNECT_S), "timeout": timedelta(seconds=request_s),
                                 "allow_http": clear},
            retry_config={"max_retries": retries, "retry_timeout": timedelta(seconds=retry_s)})
    except (BaseError, ValueError) as error:
        raise RequestError(f"storage_url {url}: {_reason(error)}") from error


def _object(meta: Any) -> Object:
    return Object(meta["path"], meta["size"], meta["last_modified"].timestamp(),
                  meta["e_tag"] or f"{meta['size']}-{meta['last_modified'].timestamp()}")


def _parts(source: Any, size: int, moved: Callable[[], None]) -> Iterator[bytes]:
    while part := source.read(size):
        yield part
        moved()


def _reason(error: Exception) -> str:
    """Return the message of an exception of obstore, without its debugging information."""
    from obstore import exceptions

    if isinstance(error, exceptions.PermissionDeniedError):
        return "permission denied"
    if isinstance(error, exceptions.UnauthenticatedError):
        return "the store does not know these keys"
    if isinstance(error, exceptions.PreconditionError):
        return "it was changed meanwhile"
    return " ".join(str(error).partition("\n\nDebug source:")[0].split())
