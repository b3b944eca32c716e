"""The files of a capture that is being taken: pictures, a capture.json that names those that there are, and the journal, acquisition.jsonl.

The journal has a line for each release of the camera and for each picture, from which a capture goes on. A line is on the
disk before what follows from it is done, so that a process that is killed has left either the picture and its line, or the line of a
release whose picture is still where the camera put it.
"""

import errno
import fcntl
import hashlib
import json
import os
import shutil
import time
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from service.acquisition.plans.shots import FLAT, Shot
from service.errors import RequestError
from stage.capture.manifest import FILE_NAME, SCHEMA, Manifest, write_manifest
from stage.colour.colour_spaces import ColorSpaceName
from stage.errors import ManifestError, storage
from stage.files import replacing
from stage.importers.camera_options import View
from stage.importers.layout import assumed_encoding, color_space_of, image_resolution
from stage.rig.rig import Rig

REJECTED = "rejected"
"""The folder of pictures that were taken again."""
JOURNAL_FILE, JOURNAL_SCHEMA = "acquisition.jsonl", "relit.acquisition/1"


class CaptureFiles:
    """The folder of a capture, and those of its calibration sequences in it."""

    def __init__(self, folder: Path, rig: Rig, shots: Sequence[Shot], color_space: ColorSpaceName | None, saturation: float | None
                 ) -> None:
        """Take the folder of the journal over."""
        self._folder, self._rig, self._shots, self._color_space, self._saturation = folder, rig, shots, color_space, saturation

    def path_of(self, shot: Shot, suffix: str) -> Path:
        """Return the path of the picture of a shot."""
        return self._folder / shot.folder / f"{shot.name}{suffix.lower()}"

    def keep(self, shot: Shot, picture: Path) -> dict[str, Any]:
        """Copy the file of a picture into the capture, whole or not at all, and return what the journal says of it."""
        path = self.path_of(shot, picture.suffix)
        digest = hashlib.sha256()
        with storage("read", picture), open(picture, "rb") as source, replacing(path) as temporary, open(temporary, "wb") as target:
            while part := source.read(1 << 20):
                digest.update(part)
                target.write(part)
        return {"file": path.relative_to(self._folder).as_posix(), "source": picture.name, "sha256": digest.hexdigest()}

    def wrong_size(self, picture: Path) -> str | None:
        """Return a sentence if the camera of the rig has another resolution than a picture."""
        camera, (columns, rows) = self._rig.camera, image_resolution(picture)
        if camera is None or camera.resolution == (columns, rows):
            return None
        width, height = camera.resolution
        return (f"camera.resolution of the rig {self._rig.name} is {width}x{height}, the picture {picture.name} has {columns}x{rows}: "
                "set the camera to the size for which it was calibrated")

    def reject(self, shot: Shot, picture: Path, attempt: int) -> dict[str, Any]:
        """Keep the file of a picture that is taken again among the rejected ones, and return what the journal says of it."""
        path = self._folder / REJECTED / f"{shot.key.replace('/', '_')}.{attempt}{picture.suffix.lower()}"
        with storage("read", picture), replacing(path) as temporary:
            shutil.copyfile(picture, temporary)
        return {"file": path.relative_to(self._folder).as_posix(), "source": picture.name}

    def withdraw(self, shot: Shot, line: Mapping[str, Any]) -> dict[str, Any]:
        """Move the picture that a shot has to the rejected ones, and return what the journal says of it."""
        path = self._folder / line["file"]
        found = self.reject(shot, path, 0) if path.exists() else {}  # else somebody has deleted it
        path.unlink(missing_ok=True)
        return {**found, "source": line["source"], "was_taken": True}

    def write_manifest(self, folder: str, taken: Mapping[str, Mapping[str, Any]], *, mask: str | None = None,
                       assumed: tuple[str, ...] = ()) -> None:
        """Write the capture.json of a folder with the pictures that there are; without any frame there is none.
        `taken`: the lines of the journal by the key of the shot. `mask`: the image of the mask in the folder. `assumed`: more sentences for
        the entry `assumed`. Raises RequestError if the camera of the rig has another resolution than the pictures."""
        frames: list[dict[str, Any]] = []
        names: list[str] = []
        flat = None
        for shot in self._shots:
            line = taken.get(shot.key)
            if shot.folder != folder or line is None:
                continue
            name = Path(line["file"]).name
            if shot.name == FLAT:
                flat = name
                continue
            if shot.grey is not None:
                continue
            names.append(name)
            frames.append({"image": name, "light": shot.light, "pattern": shot.pattern, "exposure_s": shot.exposure_s})
        if not frames:
            return
        place = self._folder / folder
        first = place / names[0]
        if (wrong := self.wrong_size(first)) is not None:
            raise RequestError(wrong)
        space = self._color_space or color_space_of(first)
        manifest = Manifest.model_validate({
            "schema": SCHEMA, "name": folder or self._folder.resolve().name, "color_space": space,
            "camera": self._rig.camera or View().entry(image_resolution(first)), "flat": flat, "saturation": self._saturation, "mask": mask,
            "assumed": (*assumed, *assumed_encoding(space, self._color_space)), "irradiance_scale": "relative", "frames": tuple(frames)})
        write_manifest(manifest, place / FILE_NAME)


class Journal:
    """The journal of one capture folder."""

    def __init__(self, folder: Path, head: Mapping[str, Any]) -> None:
        """Read the journal, if there is one; `begin` writes one with a head that says what is captured.
        Raises RequestError if the folder holds another capture than the head says; names what differs. Raises ManifestError if the journal
        is damaged; names its line. Raises StorageError if it cannot be read or written."""
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
        self._held = ExitStack()
        with storage("read", self._path):
            if self._path.exists() and self._path.stat().st_size > 0:
                self._hold()
                self._read(self._head)

    def begin(self, files: Sequence[str]) -> None:
        """Make the folder, and record what is captured and the files that were there before, where a camera writes files.
        Raises RequestError if the folder holds a capture without a journal, whose files would be replaced."""
        if (self._path.parent / FILE_NAME).exists():
            raise RequestError(f"{self._path.parent}: holds a capture that `relit capture` has not taken: give another folder to --out")
        with storage("write", self._path):
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._hold()
        self._append({**self._head, "files": list(files), "time": time.time()})

    def close(self) -> None:
        """Let other processes take this capture."""
        self._held.close()

    def _hold(self) -> None:
        """Refuse to take a capture that another process is taking, whose unfinished files this one would remove."""
        file = self._held.enter_context(open(self._path, "ab"))  # noqa: SIM115 (closed by close)
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise RequestError(f"{self._path.parent}: is being taken by another `relit capture`: wait until that has ended, or stop it"
                               ) from error
        except OSError:  # a file system without locks
            pass

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


def taken_by(lines: Iterable[dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """Return the lines of the pictures that shots have, by the key of the shot."""
    taken: dict[str, dict[str, Any]] = {}
    for line in lines:
        record(taken, line)
    return taken


def record(taken: dict[str, dict[str, Any]], line: dict[str, Any]) -> None:
    """Bring the lines of the pictures that shots have, by the key of the shot, up to date with a further line."""
    if line.get("event") == "taken":
        taken[line["shot"]] = line
    elif line.get("event") == "rejected" and line.get("was_taken"):
        taken.pop(line["shot"], None)


def _whole(content: bytes) -> bytes:
    """Return a journal without a last line that is not whole."""
    return content[:content.rfind(b"\n") + 1]
