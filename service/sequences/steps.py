"""The steps of a sequence done one after another: each whole or not at all, and not again where it is done."""

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from service.errors import RequestError
from service.reporting.progress import Progress
from service.reporting.provenance import REPORT_FILE, reported_versions, requested, with_names
from service.requests.base.base import Request
from stage.capture.capture import Capture
from stage.capture.manifest import FILE_NAME
from stage.capture.sequence import Sequence
from stage.errors import ResultError
from stage.files import write_text
from stage.stack.fingerprint import Fingerprints, digest
from stage.stack.ingest import CACHE_FOLDER

ALONE = "alone"
"""The folder, in that of a step, of what was found from the step alone."""
DONE_FILE = "step.json"
"""The file that marks a step as done, and names its inputs; written last."""
DONE_SCHEMA = "relit.step/1"


class StepProgress:
    """The progress of one step, whose stages are named after it."""

    def __init__(self, inner: Progress | None, number: int, count: int) -> None:
        """Tell `inner` of the step with this number, from 1, of `count` steps."""
        self._inner, self._place = inner, f"{number}/{count}"

    def stage(self, name: str, total: int) -> None:
        """Begin a stage."""
        if self._inner is not None:
            self._inner.stage(f"{self._place} {name}", total)

    def advance(self, done: int) -> None:
        """Pass the finished steps on."""
        if self._inner is not None:
            self._inner.advance(done)


def check_outputs(out: Path, sequence: Sequence) -> None:
    """Check that no result of a step would lie in a capture."""
    folders = {step.folder.resolve() for step in sequence.steps}
    for step in sequence.steps:
        if (out / step.name).resolve() in folders:
            raise RequestError(f"--out {out}: {step.name} in it is a capture of the sequence: choose another folder")


def capture_digest(folder: Path, request: Request, shared: object) -> str:
    """Return a hash of everything that the result of a step follows from: its capture, its request, and what other steps have given it,
    `shared`, as plain data."""
    capture = Capture.open(folder)
    names = sorted({name for _, name in capture.files()})
    hashes = Fingerprints(capture.folder, (request.cache or capture.folder / CACHE_FOLDER) / "files.json").of(names)
    content = {"files": [hashes[name] for name in names], "names": names, "manifest": digest(capture.folder / FILE_NAME),
               "options": {name: value for name, value in requested(request).items() if name != "capture"}, "versions": reported_versions(),
               "shared": shared}
    text = with_names(json.dumps(content, sort_keys=True, default=str))  # folders of a service differ from machine to machine
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


def done(folder: Path, content: str) -> dict[str, Any] | None:
    """Return what a step that is done has left for others, or None where it is not done, or not from this content of capture_digest."""
    found = _done_file(folder)
    left = found.get("left")
    return left if isinstance(left, dict) and found.get("content") == content and (folder / REPORT_FILE).is_file() else None


def _done_file(folder: Path) -> dict[str, Any]:
    """Return what the file of a step that is done says; nothing where there is none that can be read."""
    try:
        found = json.loads((folder / DONE_FILE).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) and found.get("schema") == DONE_SCHEMA else {}


def do_step(folder: Path, content: str, work: Callable[[], dict[str, Any]]) -> tuple[dict[str, Any], bool]:
    """Do a step unless it is done from this content, and say what it leaves for others, as plain data, and whether it was done before."""
    left = done(folder, content)
    if left is not None:
        return left, True
    (folder / DONE_FILE).unlink(missing_ok=True)
    left = work()
    write_text(folder / DONE_FILE, json.dumps({"schema": DONE_SCHEMA, "content": content, "left": left}) + "\n")
    return left, False


def left_by(folder: Path) -> dict[str, Any]:
    """Return what a step that is done has left for others; nothing where its file is not there."""
    left = _done_file(folder).get("left")
    return left if isinstance(left, dict) else {}


def step_report(folder: Path) -> dict[str, Any]:
    """Return the report of a step that is done."""
    try:
        found = json.loads((folder / REPORT_FILE).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ResultError(f"{folder / REPORT_FILE}: cannot be read: delete the folder and run again") from error
    return found if isinstance(found, dict) else {}
