"""Files in the folder of a capture that a job names, beside those that the manifest names."""

from collections.abc import Iterable
from pathlib import Path

from service.errors import RequestError
from stage.files import resolved


def file_within(capture: Path, name: str, field: str) -> Path:
    """Return the path of a file in the folder of a capture.

    Args:
        capture: folder of the capture.
        name: path of the file relative to it, as the job gives it.
        field: field of the job, for the message.

    Raises:
        RequestError: the name leads out of the folder, or there is no such file.
    """
    place = None if "\0" in name else resolved(capture / name)
    if place is None or not place.is_relative_to(capture.resolve()):
        raise RequestError(f"{field}: {name!r} leads out of the capture's folder")
    if not place.is_file():
        raise RequestError(f"{field}: {name!r} is no file of the capture")
    return capture / name


def files_within(capture: Path, names: Iterable[str], field: str) -> tuple[Path, ...]:
    """Return the paths of several files, as `file_within` does."""
    return tuple(file_within(capture, name, field) for name in names)
