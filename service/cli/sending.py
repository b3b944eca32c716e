"""The pictures of a capture, sent to a service in the background while others are taken."""

import hashlib
import os
import queue
import threading
from pathlib import Path

from service.acquisition.capture_files import JOURNAL_FILE
from service.cli.printing import tell
from service.client import Client, ClientError
from service.errors import RequestError
from service.requests.states import READY
from stage.capture.capture import Capture
from stage.capture.manifest import FILE_NAME
from stage.errors import StageError, storage

KEY_VARIABLE = "RELIT_KEY"
"""The environment variable of the key of the service, as `relit submit` has it."""


class Sender:
    """Sends the files of one capture; a run that goes on with the capture goes on with the same upload."""

    def __init__(self, server: str, folder: Path) -> None:
        """Take note of the address of a service and the folder of a capture; nothing is sent yet.
        Raises RequestError: the address is none of a service."""
        try:
            self._client = Client(server, os.environ.get(KEY_VARIABLE), on_silence=tell)
        except ClientError as error:
            raise RequestError(f"--to {server}: {error}") from error
        self._server, self._folder = server, folder
        self._intake, self._failed = "", False
        self._new = False  # a picture was taken since
        self._waiting: queue.Queue[str | None] = queue.Queue()
        self._thread = threading.Thread(target=self._run, name="relit-sending", daemon=True)

    def open(self) -> None:
        """Create the capture on the service, or find the one of an earlier run; the journal of the capture has begun.

        Raises:
            RequestError: the service does not answer, or refuses the key.
        """
        with storage("read", self._folder / JOURNAL_FILE), open(self._folder / JOURNAL_FILE, "rb") as journal:
            token = hashlib.sha256(journal.readline()).hexdigest()  # the first line has the time at which the capture began
        try:
            found = self._client.captures.create(self._folder.resolve().name, token=token)
        except ClientError as error:
            self._client.close()
            raise RequestError(f"--to {self._server}: {error}") from error
        self._intake, self._failed = found.id, found.state == READY
        self._thread.start()

    def send(self, name: str, *, new: bool) -> None:
        """Send a file of the capture, when those before it are sent; returns at once. `new`: whether it was taken in this run."""
        self._new = self._new or new
        self._waiting.put(name)

    def stop(self) -> None:
        """Send nothing more: the capture has ended before its last picture, and what waits is sent by the run that goes on with it."""
        self._waiting.put(None)

    def finish(self) -> str:
        """Send what is left, and return the identifier of the capture on the service when it has been checked there.

        Raises:
            RequestError: the service does not answer, or found a fault.
        """
        self._waiting.put(None)
        self._thread.join()
        names = {name for _, name in Capture.open(self._folder).files()} | {FILE_NAME}
        try:
            captures = self._client.captures
            ready = captures.get(self._intake).state == READY
            if ready and self._new:  # the service has it without the picture that was taken again: its files do not change any more
                self._intake = captures.create(self._folder.resolve().name).id
            if self._new or not ready:
                captures.send(self._intake, [(self._folder / name, name) for name in sorted(names)])
                captures.validate(self._intake)
            return captures.wait(self._intake).id
        except ClientError as error:
            raise RequestError(f"--to {self._server}: {error}: the capture is whole here: run the same command again to send the rest"
                               ) from error
        finally:
            self._client.close()

    def _run(self) -> None:
        while (name := self._waiting.get()) is not None:
            if self._failed:  # what is left is sent at the end, where an error has somebody to read it
                continue
            try:
                self._client.captures.send(self._intake, [(self._folder / name, name)])
            except (ClientError, StageError, OSError):
                self._failed = True
