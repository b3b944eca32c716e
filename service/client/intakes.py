"""Captures and environments: uploaded or registered, listed and deleted, and annotated; their files go by tus 1.0."""

import hashlib
import secrets
import time
from base64 import b64encode
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from threading import Event

import httpx2

from service.client.connection import LATER, PROXY, Connection, retry_after
from service.client.errors import Conflict, FileError, IntakeRefused, NotFound, refusal
from service.client.local_files import LocalFile, file_errors, files_of, hash_files, hash_of_all
from service.client.transfer import PIECE_BYTES, Stopped, TransferProgress, transfer_all
from service.reporting.progress import Progress
from service.requests.answers import IntakePage, IntakeView
from service.requests.base.annotations import AnnotationPage, AnnotationView
from service.requests.states import CHECKING, READY, RECEIVING, REFUSED

TUS = {"Tus-Resumable": "1.0.0"}
OTHER_OFFSET = (409, 423)
"""Statuses of the server when it has another number of bytes than the client assumed, or still writes those of an earlier request."""


class Upload:
    """The upload of one file by tus 1.0 (https://tus.io/protocols/resumable-upload); bytes that the server has are not sent again."""

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


FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.1, 2.0
"""First and longest pause, in seconds, between two requests for the state of an intake that is being checked; each pause is 1.5 times the
one before."""
GENERATIONS = 100
"""Number of earlier uploads of the same files, each deleted since, that are looked for before the files are uploaded without a token."""


class Intakes:
    """The captures of a project, or its environments: the two kinds of files that jobs take in."""

    def __init__(self, connection: Connection, path: str, source: str, *, parallel: int) -> None:
        self._connection, self._path, self._source, self._parallel = connection, path, source, parallel

    def upload(self, source: Path, *, name: str | None = None, progress: Progress | None = None) -> IntakeView:
        """Upload a folder or a file, and wait until jobs can use it.

        The same files under the same name, sent again by this or another process, give the same capture: what the server has is not sent
        twice, and an interrupted upload is continued.

        Args:
            source: a capture's folder, or the image of an environment. Files and folders whose names begin with a dot are left out.
            name: shown to people; None: the name of the folder or file.
            progress: told of the stages `hash` and `upload`, in MiB.

        Raises:
            FileError: a file cannot be read, or a folder holds no manifest; nothing is sent then.
            IntakeRefused: the check found a fault.
            ClientError: the service answers with an error, or does not answer.
        """
        name = source.resolve().name if name is None else name
        found = files_of(source)
        if self._source == "folder" and not any(name.endswith(".json") for _, name in found):
            raise FileError(f"{source}: holds no capture.json: relit import writes one, as the pages of the service do")
        size = sum(path.stat().st_size for path, _ in found)
        files = hash_files(found, parallel=self._parallel, progress=TransferProgress(progress, "hash", size))
        token = hashlib.sha256(f"{self._path}\0{name}\0{hash_of_all(files)}".encode()).hexdigest()
        intake = self._create_once(name, token)
        if intake.state == READY:
            return intake
        if intake.state in (RECEIVING, REFUSED):
            if intake.state == RECEIVING:
                told = TransferProgress(progress, "upload", sum(file.size for file in files))
                transfer_all((Upload(self._connection, self._at(intake.id), file, told).run for file in files), parallel=self._parallel)
            self.validate(intake.id)
        return self.wait(intake.id)

    def register(self, path: str, *, name: str | None = None) -> IntakeView:
        """Use a folder or file of the server where it lies, and wait until it is checked; the key needs the scope admin.

        Args:
            path: absolute path on the server, below a folder that its operator allows.
            name: shown to people; None: the last part of the path.

        Raises:
            IntakeRefused: the check found a fault.
            ClientError: the service answers with an error, or does not answer.
        """
        name = path.rstrip("/").rpartition("/")[2] or path if name is None else name
        return self.wait(self.create(name, path=path).id)

    def create(self, name: str, *, path: str | None = None, token: str | None = None) -> IntakeView:
        """Create an intake that receives files or, with `path`, one that registers a path of the server; `upload` and `register` call this.

        `token` is the Idempotency-Key; None: a new one.
        """
        return self._connection.ask(IntakeView, "POST", self._path, json={"name": name, **({} if path is None else {self._source: path})},
                                    headers={"Idempotency-Key": token or secrets.token_hex(16)})

    def send(self, intake: str, files: list[tuple[Path, str]]) -> None:
        """Send files to an intake that receives them; bytes that the server has are not sent twice, and a file of a path replaces another.

        Args:
            files: paths and their names in the intake.
        """
        hashed = hash_files(files, parallel=self._parallel, progress=TransferProgress(None, "hash", 0))
        told = TransferProgress(None, "upload", 0)
        transfer_all((Upload(self._connection, self._at(intake), file, told).run for file in hashed), parallel=self._parallel)

    def validate(self, intake: str) -> IntakeView:
        """End the upload and begin the check; an intake that is being checked or is ready does not change."""
        try:
            return self._connection.ask(IntakeView, "POST", f"{self._at(intake)}/validate")
        except Conflict:
            found = self.get(intake)
            if found.state == RECEIVING:
                raise
            return found

    def wait(self, intake: str) -> IntakeView:
        """Wait until an intake is checked; raise IntakeRefused if the check found a fault."""
        pause = FIRST_PAUSE_S
        while (found := self.get(intake)).state == CHECKING:
            time.sleep(pause)
            pause = min(1.5 * pause, LONGEST_PAUSE_S)
        if found.state == REFUSED:
            raise IntakeRefused(found)
        return found

    def get(self, intake: str) -> IntakeView:
        """Return one capture or environment."""
        return self._connection.ask(IntakeView, "GET", self._at(intake))

    def all(self) -> Iterator[IntakeView]:
        """Iterate over all captures or environments of the project, the newest first."""
        for page in self._connection.pages(IntakePage, self._path, "before"):
            yield from page.items

    def delete(self, intake: str) -> None:
        """Delete one that no queued or running job reads; files that were registered stay where they lie."""
        self._connection.send("DELETE", self._at(intake), repeatable=False)

    def _at(self, intake: str) -> str:
        return self._connection.path(self._path, intake)

    def _create_once(self, name: str, token: str) -> IntakeView:
        """Return the intake that was created with the token; if that has been deleted since, the intake of the next token."""
        for number in range(GENERATIONS):
            with suppress(NotFound):
                return self.create(name, token=f"{token}-{number}")
        return self.create(name)


class Annotations:
    """The annotations of the captures of a project."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection

    def page(self, capture: str) -> AnnotationPage:
        """Return the annotations of a capture; `model_dump_json(by_alias=True)` of it is a file for `relit publish --annotations`."""
        return self._connection.ask(AnnotationPage, "GET", self._at(capture))

    def add(self, capture: str, text: str, x: float, y: float, width: float = 0.0, height: float = 0.0) -> AnnotationView:
        """Add a text about a rectangle of the image, in pixels from its upper left corner; without a size about a point."""
        selector = ({"type": "FragmentSelector", "value": f"xywh={x:g},{y:g},{width:g},{height:g}"} if width or height else
                    {"type": "PointSelector", "x": x, "y": y})
        body = {"body": {"type": "TextualBody", "value": text}, "target": {"selector": selector}}
        return self._connection.ask(AnnotationView, "POST", self._at(capture), json=body, repeatable=False)

    def delete(self, annotation: AnnotationView) -> None:
        """Delete an annotation."""
        self._connection.send("DELETE", annotation.id, repeatable=False)

    def _at(self, capture: str) -> str:
        return self._connection.path("/v1/captures", capture, "annotations")
