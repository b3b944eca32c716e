"""The exceptions that stage/ raises.

StageError
├── ManifestError    capture.json or another JSON description is wrong; the message names file and field
├── ImageError       a file does not hold the pixels that it should hold; the message names the file
├── ColourError      a colour space or an OpenColorIO configuration cannot be used; the message names it
├── CalibrationError images do not show what is measured in them, as a spot on a ball; the message names frame, ball or field
├── BoardError       the tiles of a board do not fit together, or a board does not fit its design; the message names them
├── ScanError        scans of one object cannot be placed; the message names them
├── ResultError      a result file such as maps.exr lacks a layer; the message names file and layer
└── StorageError     the file system refuses for lack of space or permission; the message names path and reason

Every function of stage/ that reads or writes a file raises StorageError where the file system refuses. Every reader raises ImageError (of
pixels), ResultError (of results) or ManifestError (of JSON) where a file is damaged, truncated or not what it should be. Docstrings name
further reasons only.
"""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from os import PathLike, strerror

MOST_FAULTS = 20
"""The most faults that one error lists."""


class StageError(Exception):
    """The base of all exceptions that stage/ raises; the message is one plain sentence, and `args` has one for each fault."""

    def __str__(self) -> str:
        """Return the sentences of all faults."""
        return "; ".join(map(str, self.args))


class ManifestError(StageError, ValueError):
    """A manifest or calibration file is wrong; the message names file and field."""


class ImageError(StageError, ValueError):
    """An image cannot be used; the message names the file."""


class ColourError(StageError, ValueError):
    """A colour space or a configuration of colours cannot be used; the message names it."""


class CalibrationError(StageError, ValueError):
    """The images do not determine a calibration; the message names the frame, the ball or the field."""


class BoardError(StageError, ValueError):
    """Tiles of a board do not fit together, or a board does not fit its nominal heights; the message names the tiles or the file."""


class ScanError(StageError, ValueError):
    """Scans of one object cannot be placed against each other; the message names the file or the scans."""


class ResultError(StageError, ValueError):
    """A result file cannot be used; the message names the file and the layer."""


class StorageError(StageError, OSError):
    """The file system refuses an operation; the message names the path and the reason."""


def listed(sentences: Iterable[str], rest: str) -> list[str]:
    """Return the first different sentences, MOST_FAULTS of them, and `rest` where there are more; no more than these are made."""
    first: dict[str, None] = {}
    for sentence in sentences:
        if sentence not in first and len(first) == MOST_FAULTS:
            return [*first, rest]
        first[sentence] = None
    return list(first)


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
