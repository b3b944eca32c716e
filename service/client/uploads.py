"""Uploads that can be resumed: the client's side of tus 1.0 (https://tus.io/protocols/resumable-upload)."""

import hashlib
import threading
from base64 import b64encode
from collections.abc import Iterator
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait

import httpx2

from service.client.errors import FileError, refusal
from service.client.files import PIECE, LocalFile, reading
from service.client.link import LATER, PROXY, Link, retry_after
from service.client.tally import Tally

TUS = {"Tus-Resumable": "1.0.0"}
ELSEWHERE = (409, 423)
"""Statuses with which the offset is another than was thought, or a request before is still being written."""


class _Ended(Exception):
    """Another file of the same upload failed."""


def send_files(link: Link, intake: str, files: list[LocalFile], *, parallel: int, tally: Tally) -> None:
    """Upload the files of a capture or environment, several at once; what is there already is not sent again.

    Args:
        link: to the service.
        intake: path of the capture or environment.
        files: to send.
        parallel: files at once.
        tally: told of every byte.

    Raises:
        ClientError: one file could not be sent; the others have been stopped, and can be gone on with.
    """
    ended = threading.Event()
    pool = ThreadPoolExecutor(parallel)
    try:
        futures = [pool.submit(_Upload(link, intake, file, tally, ended).send) for file in files]
        done, _ = wait(futures, return_when=FIRST_EXCEPTION)
        for future in done:
            future.result()
    finally:  # also where Ctrl-C comes
        ended.set()
        pool.shutdown(cancel_futures=True)


class _Upload:
    """One file on its way."""

    def __init__(self, link: Link, intake: str, file: LocalFile, tally: Tally, ended: threading.Event) -> None:
        self._link, self._intake, self._file, self._tally, self._ended = link, intake, file, tally, ended
        self._sent = 0

    def send(self) -> None:
        """Send what the service does not have yet, until it has all."""
        if self._ended.is_set():
            return
        file = self._file
        upload, offset = self._create()
        patience, before = self._link.patience(), offset
        while offset < file.size:
            if offset > before:
                patience.refresh()
            before = offset
            self._tell(offset)
            try:
                answer = self._link.once("PATCH", upload, content=self._pieces(offset), headers={
                    **TUS, "Upload-Offset": str(offset), "Content-Type": "application/offset+octet-stream",
                    "Content-Length": str(file.size - offset)})
            except _Ended:
                return
            except httpx2.TransportError as error:
                if not patience.wait():
                    raise self._link.unreachable(error) from error
                offset = self._offset(upload)
                continue
            if answer.is_success:
                offset = int(answer.headers["upload-offset"])
            elif answer.status_code in (*ELSEWHERE, *LATER, *PROXY) and patience.wait(retry_after(answer)):
                offset = self._offset(upload)
            else:
                raise refusal(answer.status_code, answer.headers.get("content-type", ""), answer.content)
        self._tell(file.size)

    def _create(self) -> tuple[str, int]:
        """Path of the upload, and how much of it is there; the same one when it is asked for again, also by another run of the program."""
        words = {"path": self._file.name, "sha256": self._file.sha256}
        metadata = ",".join(f"{name} {b64encode(word.encode()).decode()}" for name, word in words.items())
        token = hashlib.sha256(f"{self._intake}\0{self._file.name}\0{self._file.sha256}".encode()).hexdigest()
        answer = self._link.send("POST", f"{self._intake}/files", headers={
            **TUS, "Upload-Length": str(self._file.size), "Upload-Metadata": metadata, "Idempotency-Key": token})
        path = httpx2.URL(answer.headers["location"]).path  # the key is for no other host
        return path, int(answer.headers["upload-offset"])

    def _offset(self, upload: str) -> int:
        return int(self._link.send("HEAD", upload, headers=TUS).headers["upload-offset"])

    def _tell(self, sent: int) -> None:
        self._tally.add(sent - self._sent)
        self._sent = sent

    def _pieces(self, offset: int) -> Iterator[bytes]:
        with reading(self._file.path), open(self._file.path, "rb", buffering=0) as opened:
            opened.seek(offset)
            while offset < self._file.size:
                if self._ended.is_set():
                    raise _Ended
                piece = opened.read(min(PIECE, self._file.size - offset))
                if not piece:
                    raise FileError(f"{self._file.path}: became shorter while it was sent")
                offset += len(piece)
                yield piece
                self._tell(offset)
