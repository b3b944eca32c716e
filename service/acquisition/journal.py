"""The journal of a capture, acquisition.jsonl: a line for each release of the camera and for each picture, from which a capture goes on.

A line is on the disk before what follows from it is done, so that a process that is killed has left either the picture and its line, or the
line of a release whose picture is still where the camera put it.
"""

import errno
import json
import os
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from service.errors import RequestError
from stage.errors import ManifestError, storage

JOURNAL_FILE, JOURNAL_SCHEMA = "acquisition.jsonl", "relit.acquisition/1"


class Journal:
    """The journal of one capture folder."""

    def __init__(self, folder: Path, head: Mapping[str, Any]) -> None:
        """Read the journal, if there is one; `begin` writes one with a head that says what is captured.

        Raises:
            RequestError: the folder holds another capture than the head says; names what differs.
            ManifestError: the journal is damaged; names its line.
            StorageError: it cannot be read or written.
        """
        self._path = folder / JOURNAL_FILE
        self.taken: dict[str, dict[str, Any]] = {}
        """The line of the picture that each shot has, by the key of the shot."""
        self.released: dict[str, Any] | None = None
        """The line of the last release whose picture is not recorded."""
        self.known: set[str] | None = None
        """The names of files that were there before the capture began, or that the camera wrote for it; None: it has just begun."""
        self.settings: Mapping[str, str] = {}
        """The settings that the camera told when the first picture was to be taken, by name."""
        self._head = {"schema": JOURNAL_SCHEMA, **head}
        with storage("read", self._path):
            if self._path.exists() and self._path.stat().st_size > 0:
                self._read(self._head)

    def begin(self, files: Sequence[str]) -> None:
        """Make the folder, and record what is captured and the files that were there before, where a camera writes files."""
        with storage("write", self._path):
            self._path.parent.mkdir(parents=True, exist_ok=True)
        self._append({**self._head, "files": list(files), "time": time.time()})

    def camera(self, settings: Mapping[str, str]) -> None:
        """Record the settings that the camera tells, if no picture was taken under earlier ones."""
        if not self.taken:
            self._append({"event": "camera", "settings": dict(settings), "time": time.time()})
            self.settings = settings

    def release(self, key: str, attempt: int) -> None:
        """Record that the camera is about to be released for a shot."""
        self._append({"event": "released", "shot": key, "attempt": attempt, "time": time.time()})

    def picture(self, key: str, event: str, line: Mapping[str, Any]) -> None:
        """Record the picture of a shot; `event` is taken, rejected, or compared with one that was taken earlier."""
        found = {"event": event, "shot": key, **line, "time": time.time()}
        self._append(found)
        self._take(found)

    def _append(self, line: Mapping[str, Any]) -> None:
        with storage("write", self._path), open(self._path, "ab", buffering=0) as file:
            end = file.tell()
            text = (json.dumps(line) + "\n").encode()
            try:
                if file.write(text) < len(text):
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
                os.fsync(file.fileno())
            except OSError:
                file.truncate(end)
                raise

    def _take(self, line: dict[str, Any]) -> None:
        if "source" in line:
            self.known = {*(self.known or ()), line["source"]}
        record(self.taken, line)

    def _read(self, head: Mapping[str, Any]) -> None:
        content = self._path.read_bytes()
        whole = _whole(content)
        if len(whole) < len(content):  # the process ended within a line, which nothing follows from
            os.truncate(self._path, len(whole))
        for number, text in enumerate(whole.decode("utf-8", "replace").splitlines(), start=1):
            try:
                line = json.loads(text)
                if number == 1:
                    self._compare(line, head)
                    self.known = set(line["files"])
                elif line["event"] == "released":
                    self.released = line
                elif line["event"] == "camera":
                    self.settings = dict(line["settings"])
                else:
                    self._take(line)
                    self.released = None
            except (ValueError, KeyError, TypeError) as error:
                if isinstance(error, RequestError):
                    raise
                raise ManifestError(f"{self._path}: line {number} is damaged: take it out, and the picture of its shot is taken again"
                                    ) from error

    def _compare(self, found: Mapping[str, Any], head: Mapping[str, Any]) -> None:
        for key, value in json.loads(json.dumps(head)).items():
            if found.get(key) != value:
                raise RequestError(f"{self._path.parent}: was begun with another {key.replace('_', ' ')}: go on with the same, or give "
                                   "another folder to --out")


def lines_of(folder: Path) -> list[dict[str, Any]]:
    """Return the whole lines of the journal of a capture that may be going on; the first is its head."""
    path = folder / JOURNAL_FILE
    return [json.loads(line) for line in _whole(path.read_bytes()).splitlines()] if path.exists() else []


def record(taken: dict[str, dict[str, Any]], line: dict[str, Any]) -> None:
    """Bring the lines of the pictures that shots have, by the key of the shot, up to date with a further line."""
    if line.get("event") == "taken":
        taken[line["shot"]] = line
    elif line.get("event") == "rejected" and line.get("was_taken"):
        taken.pop(line["shot"], None)


def _whole(content: bytes) -> bytes:
    """Return a journal without a last line that is not whole."""
    return content[:content.rfind(b"\n") + 1]
