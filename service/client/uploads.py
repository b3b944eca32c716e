"""Resumable uploads: the client's side of tus 1.0 (https://tus.io/protocols/resumable-upload)."""

import hashlib
from base64 import b64encode
from collections.abc import Iterator
from threading import Event

import httpx2

from service.client.connection import LATER, PROXY, Connection, retry_after
from service.client.errors import FileError, refusal
from service.client.local_files import LocalFile, file_errors
from service.client.transfer import PIECE_BYTES, Stopped, TransferProgress

TUS = {"Tus-Resumable": "1.0.0"}
OTHER_OFFSET = (409, 423)
"""Statuses of the server when it has another number of bytes than the client assumed, or still writes those of an earlier request."""


class Upload:
    """The upload of one file; bytes that the server has already are not sent again."""

    def __init__(self, connection: Connection, intake: str, file: LocalFile, progress: TransferProgress) -> None:
        self._connection, self._intake, self._file, self._progress = connection, intake, file, progress
        self._sent = 0

    def run(self, stop: Event) -> None:
        """Send the bytes that the server does not have, until it has all or `stop` is set."""
        if stop.is_set():
            raise Stopped
        file = self._file
        upload, offset = self._create()
        backoff, before = self._connection.backoff(), offset
        while offset < file.size:
            if offset > before:
                backoff.reset()
            before = offset
            self._report(offset)
            try:
                answer = self._connection.http.request("PATCH", upload, content=self._pieces(offset, stop), headers={
                    **TUS, "Upload-Offset": str(offset), "Content-Type": "application/offset+octet-stream",
                    "Content-Length": str(file.size - offset)})
            except httpx2.TransportError as error:
                if not backoff.wait():
                    raise self._connection.unreachable(error) from error
                offset = self._offset(upload)
                continue
            if answer.is_success:
                offset = int(answer.headers["upload-offset"])
            elif answer.status_code in (*OTHER_OFFSET, *LATER, *PROXY) and backoff.wait(retry_after(answer)):
                offset = self._offset(upload)
            else:
                raise refusal(answer)
        self._report(file.size)

    def _create(self) -> tuple[str, int]:
        """Return the path of the upload and the bytes it has; a second call, also by another process, returns the same upload."""
        words = {"path": self._file.name, "sha256": self._file.sha256}
        metadata = ",".join(f"{name} {b64encode(word.encode()).decode()}" for name, word in words.items())
        token = hashlib.sha256(f"{self._intake}\0{self._file.name}\0{self._file.sha256}".encode()).hexdigest()
        answer = self._connection.send("POST", f"{self._intake}/files", headers={
            **TUS, "Upload-Length": str(self._file.size), "Upload-Metadata": metadata, "Idempotency-Key": token})
        path = httpx2.URL(answer.headers["location"]).path  # the path alone, so that the key is never sent to another host
        return path, int(answer.headers["upload-offset"])

    def _offset(self, upload: str) -> int:
        return int(self._connection.send("HEAD", upload, headers=TUS).headers["upload-offset"])

    def _report(self, sent: int) -> None:
        self._progress.add(sent - self._sent)
        self._sent = sent

    def _pieces(self, offset: int, stop: Event) -> Iterator[bytes]:
        with file_errors(self._file.path), open(self._file.path, "rb", buffering=0) as opened:
            opened.seek(offset)
            while offset < self._file.size:
                if stop.is_set():
                    raise Stopped
                piece = opened.read(min(PIECE_BYTES, self._file.size - offset))
                if not piece:
                    raise FileError(f"{self._file.path}: became shorter while it was sent")
                offset += len(piece)
                yield piece
                self._report(offset)
