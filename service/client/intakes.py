"""Captures and environments: handed in, looked at, deleted."""

import hashlib
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from service.client.errors import Conflict, IntakeRefused, NotFound
from service.client.files import files_of, hashed, manifest_hash
from service.client.link import Link
from service.client.tally import Tally
from service.client.uploads import send_files
from service.reporting.progress import Progress
from service.server.api.views import IntakePage, IntakeView

RECEIVING, CHECKING, READY, REFUSED = "receiving", "checking", "ready", "refused"
FIRST_LOOK_S, LATER_LOOK_S = 0.1, 2.0
"""Between two looks at what is being checked; each is half as long again as the one before."""


GENERATIONS = 100
"""How often the same files may have been uploaded and deleted again before they are sent without looking for an earlier upload."""


class Intakes:
    """The captures of a project, or its environments."""

    def __init__(self, link: Link, path: str, source: str, *, parallel: int) -> None:
        """Args: link: to the service. path: of the API. source: field that names what is registered. parallel: files sent at once."""
        self._link, self._path, self._source, self._parallel = link, path, source, parallel

    def upload(self, source: Path, *, name: str | None = None, progress: Progress | None = None) -> IntakeView:
        """Send a folder, or a file, and wait until it can be used.

        The same files sent again, by this program or another run of it, are the same capture: what is there is not sent twice, and what
        was broken off is gone on with.

        Args:
            source: a capture's folder, or the image of an environment. What has a leading dot in its name is left out.
            name: for people; None: that of the folder or file.
            progress: told of `hash` and `upload`, in MiB.

        Raises:
            FileError: a file cannot be read.
            IntakeRefused: the check found something wrong.
            ClientError: the service says no, or does not answer.
        """
        name = source.resolve().name if name is None else name
        found = files_of(source)
        files = hashed(found, parallel=self._parallel, tally=Tally(progress, "hash", sum(path.stat().st_size for path, _ in found)))
        token = hashlib.sha256(f"{self._path}\0{name}\0{manifest_hash(files)}".encode()).hexdigest()
        intake = self._created_once(name, token)
        if intake.state == READY:
            return intake
        if intake.state in (RECEIVING, REFUSED):
            if intake.state == RECEIVING:
                send_files(self._link, self._at(intake.id), files, parallel=self._parallel,
                           tally=Tally(progress, "upload", sum(file.size for file in files)))
            self.validate(intake.id)
        return self.wait(intake.id)

    def register(self, path: str, *, name: str | None = None) -> IntakeView:
        """Use what lies on the server, under a folder that its operator allows, and wait until it is checked; needs the scope admin.

        Args:
            path: absolute, of the server.
            name: for people; None: the last part of the path.

        Raises:
            IntakeRefused: the check found something wrong.
            ClientError: the service says no, or does not answer.
        """
        name = path.rstrip("/").rpartition("/")[2] or path if name is None else name
        return self.wait(self.create(name, path=path).id)

    def create(self, name: str, *, path: str | None = None, token: str | None = None) -> IntakeView:
        """Create one that takes files, or registers what lies on the server; `upload` and `register` do it all.

        Args:
            name: for people.
            path: of the server; None: files come.
            token: Idempotency-Key; None: a new one.
        """
        answer = self._link.send("POST", self._path, json={"name": name, **({} if path is None else {self._source: path})},
                                 headers={"Idempotency-Key": token or self._link.token()})
        return IntakeView.model_validate_json(answer.content)

    def validate(self, intake: str) -> IntakeView:
        """Take no more files, and have those that are there checked; one that is being checked, or is ready, stays as it is.

        Raises:
            Conflict: a file is not complete.
        """
        try:
            return IntakeView.model_validate_json(self._link.send("POST", f"{self._at(intake)}/validate").content)
        except Conflict:
            found = self.get(intake)
            if found.state == RECEIVING:
                raise
            return found

    def wait(self, intake: str) -> IntakeView:
        """Wait until one is checked.

        Raises:
            IntakeRefused: the check found something wrong.
        """
        pause = FIRST_LOOK_S
        while (found := self.get(intake)).state == CHECKING:
            time.sleep(pause)
            pause = min(1.5 * pause, LATER_LOOK_S)
        if found.state == REFUSED:
            raise IntakeRefused(found)
        return found

    def get(self, intake: str) -> IntakeView:
        """One of them."""
        return IntakeView.model_validate_json(self._link.send("GET", self._at(intake)).content)

    def all(self) -> Iterator[IntakeView]:
        """All of them, the newest first."""
        before: str | None = None
        while True:
            answer = self._link.send("GET", self._path, params={} if before is None else {"before": before})
            page = IntakePage.model_validate_json(answer.content)
            yield from page.items
            if (before := page.next) is None:
                return

    def delete(self, intake: str) -> None:
        """Remove one that no waiting or running job reads; what was registered stays where it lies."""
        self._link.send("DELETE", self._at(intake), repeatable=False)

    def _at(self, intake: str) -> str:
        return self._link.path(self._path, intake)

    def _created_once(self, name: str, token: str) -> IntakeView:
        """The one that the token made; where it has been deleted since, that of the next token."""
        for number in range(GENERATIONS):
            with suppress(NotFound):
                return self.create(name, token=f"{token}-{number}")
        return self.create(name)
