"""Resumable downloads of results; a file has its name only when it is complete."""

import hashlib
import os
from glob import escape
from pathlib import Path, PurePosixPath
from threading import Event
from urllib.parse import quote

import httpx2

from service.client.connection import LATER, PROXY, Connection, retry_after
from service.client.errors import FileError, refusal
from service.client.local_files import file_errors
from service.client.transfer import PIECE_BYTES, Stopped, TransferProgress

PARTIAL = 206
PLAIN = {"Accept-Encoding": "identity"}
"""Ask for the bytes of the file without compression, so that ranges count them."""


class Download:
    """The download of one file: into a hidden file named after its ETag, so that parts of two versions are never mixed."""

    def __init__(self, connection: Connection, results: str, name: str, folder: Path, progress: TransferProgress) -> None:
        self._connection, self._name, self._progress = connection, name, progress
        self._url, self._target = f"{results}/{quote(name)}", folder / _safe(name)
        self._etag, self._size, self._got = "", -1, 0

    def run(self, stop: Event) -> Path:
        """Fetch the bytes that are missing, until the file is complete or `stop` is set."""
        with file_errors(self._target.parent, "make"):
            self._target.parent.mkdir(parents=True, exist_ok=True)
        if self._parts():
            self._note(self._connection.send("HEAD", self._url, headers=PLAIN))
        backoff = self._connection.backoff()
        while self._got != self._size:
            before = self._got
            try:
                later = self._fetch(stop)
            except httpx2.TransportError as error:
                if self._got <= before and not backoff.wait():
                    raise self._connection.unreachable(error) from error
            else:
                if later is not None and not backoff.wait(retry_after(later)):
                    raise refusal(later)
            if self._got > before:
                backoff.reset()
        with file_errors(self._target, "write"):
            os.replace(self._part, self._target)
            for left in self._parts():
                left.unlink()
        return self._target

    def _fetch(self, stop: Event) -> httpx2.Response | None:
        """Append the bytes of one answer to the part; return the answer instead if it asks to come back later."""
        if stop.is_set():
            raise Stopped
        headers = PLAIN | ({"Range": f"bytes={self._got}-", "If-Range": self._etag} if self._got else {})
        with self._connection.http.stream("GET", self._url, headers=headers) as answer:
            if answer.status_code in (*LATER, *PROXY):
                answer.read()
                return answer
            if not answer.is_success:
                raise refusal(answer)
            if answer.status_code != PARTIAL:  # the whole file, and perhaps another version than before
                self._note(answer)
                self._report(0)
            with file_errors(self._part, "write"), open(self._part, "ab" if self._got else "wb", buffering=PIECE_BYTES) as part:
                for piece in answer.iter_raw():
                    if stop.is_set():
                        raise Stopped
                    part.write(piece)
                    self._report(self._got + len(piece))
        return None

    def _note(self, answer: httpx2.Response) -> None:
        """Take the version and size of the file from an answer, and see how many bytes of that version are on disk."""
        self._etag, self._size = answer.headers["etag"], int(answer.headers["content-length"])
        there = self._part.stat().st_size if self._part.exists() else 0
        self._report(there if there <= self._size else 0)

    @property
    def _part(self) -> Path:
        version = hashlib.sha256(self._etag.encode()).hexdigest()[:16]
        return self._target.with_name(f".{self._target.name}.{version}.part")

    def _parts(self) -> list[Path]:
        return list(self._target.parent.glob(f".{escape(self._target.name)}.{'?' * 16}.part"))

    def _report(self, got: int) -> None:
        self._progress.add(got - self._got)
        self._got = got


def _safe(name: str) -> PurePosixPath:
    """Return a name that the service gave as a relative path that stays below the folder."""
    path = PurePosixPath(name)
    if path.is_absolute() or not path.parts or ".." in path.parts or "\\" in name or "\0" in name or ":" in name:
        raise FileError(f"{name!r}: the service names a file that cannot be written here")
    return path
