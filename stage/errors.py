"""Errors of the stage floor.

StageError
├── ManifestError    capture.json (or another description) is not what it must be; names the field
├── ImageError       a file cannot be read as the pixels it should hold; names the file
├── CalibrationError the images do not show what is to be measured in them (no spot on the ball); names frame or ball
├── ResultError      a result file (maps.exr, …) lacks what is asked of it; names the file
└── StorageError     the disk refuses: no space, no permission, unreadable folder; names the path
"""

from collections.abc import Iterator
from contextlib import contextmanager
from os import PathLike, strerror


class StageError(Exception):
    """Base of everything that stage/ raises on purpose; its text is one plain sentence."""


class ManifestError(StageError, ValueError):
    """A manifest or calibration file is wrong: the message names file and field."""


class ImageError(StageError, ValueError):
    """An image cannot be used: the message names the file."""


class CalibrationError(StageError, ValueError):
    """A calibration cannot be had from these images: the message names the frame, the ball or the field."""


class ResultError(StageError, ValueError):
    """A result file cannot be used: the message names the file and the layer."""


class StorageError(StageError, OSError):
    """The file system refuses: the message names the path and the reason."""


@contextmanager
def storage(action: str, path: str | PathLike[str]) -> Iterator[None]:
    """Turn an OSError inside the block into one sentence: `cannot {action} {path}: {reason}`."""
    try:
        yield
    except StageError:
        raise
    except OSError as error:
        reason = strerror(error.errno).lower() if error.errno else str(error)
        raise StorageError(f"cannot {action} {path}: {reason}") from error
