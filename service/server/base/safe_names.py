"""Names of uploaded files: a name must mean the same file, and only that file, on every system that may read it.

Results and captures are opened from Windows, macOS and Linux, so a name is refused that one of them does not allow, or takes for another.
"""

import unicodedata

from service.errors import RequestError
from stage.model import name_fault

MAX_PART_BYTES = 255
"""Bytes of the name of a file or folder at most, as in common file systems."""
MAX_PATH_BYTES = 800
"""Bytes of the whole path at most. Folding makes it up to three times as long, and PostgreSQL indexes no more than 2704 bytes."""
MAX_DEPTH = 8
"""Names in a path at most: a capture needs one, a sequence of captures two."""
FORBIDDEN = '<>:"\\|?*'
"""Characters that Windows forbids, or that lead elsewhere there."""
HIDDEN_CATEGORIES = {
    "Cf": "a character that is not seen and changes how the others are",
    "Cn": "a character that is not assigned",
    "Zl": "a line separator",
    "Zp": "a paragraph separator",
}
DEVICES = {"con", "prn", "aux", "nul", "conin$", "conout$", *(f"{port}{digit}" for port in ("com", "lpt") for digit in "0123456789¹²³")}
SHOWN = 100
"""Characters of a refused name that a sentence repeats at most."""


class NameFault(RequestError):
    """A name cannot be used for a file; the message says why in one sentence."""


def check_path(path: str) -> None:
    """Raise NameFault if a path within a capture, with / between folders, is not safe on every system."""
    if fault := _fault(path):
        raise NameFault(f"path {shown(path)}: {fault}")


def shown(path: str) -> str:
    """Return a name for a sentence: in quotes, with unprintable characters as escapes, and shortened."""
    text = "".join(character if character.isprintable() else ascii(character)[1:-1] for character in path[:SHOWN])
    return f'"{text}"' if len(path) <= SHOWN else f'"{text}…"'


def folded(path: str) -> str:
    """Return a form of a path that is equal for paths which differ only in case (Unicode 3.13, canonical caseless matching)."""
    return unicodedata.normalize("NFD", unicodedata.normalize("NFD", path).casefold())


def folders_of(path: str) -> list[str]:
    """Return the folders of a path, the outermost first."""
    parts = path.split("/")
    return ["/".join(parts[:count]) for count in range(1, len(parts))]


def _fault(path: str) -> str | None:
    if not path:
        return "is empty: a file has a name"
    if len(path.encode(errors="surrogatepass")) > MAX_PATH_BYTES:
        return f"is longer than {MAX_PATH_BYTES} bytes"
    if fault := name_fault(path):
        return fault
    for character in path:
        if what := HIDDEN_CATEGORIES.get(unicodedata.category(character)):
            return f"has {what} (U+{ord(character):04X}): leave it out"
    if path.startswith("/"):
        return "is absolute: give it relative to the capture"
    for character in FORBIDDEN:
        if character in path:
            return f"has {character}, which cannot be in a name everywhere: folders have / between"
    if unicodedata.normalize("NFC", path) != path:
        return "is not in the Unicode form NFC: other systems would write the same name in other bytes"
    parts = path.split("/")
    if len(parts) > MAX_DEPTH:
        return f"is {len(parts)} names deep, {MAX_DEPTH} are allowed"
    return next((fault for part in parts if (fault := _part_fault(part))), None)


def _part_fault(part: str) -> str | None:
    if not part:
        return "has an empty name between two /, or at its end"
    if part == "..":
        return "has .., which leads out of the folder"
    if part.startswith("."):
        return "has a name that begins with a dot: such files are hidden, and those of the service itself"
    if part[-1] in " .":
        return "has a name that ends with a space or a dot, which Windows leaves out"
    if part[0] == " ":
        return "has a name that begins with a space"
    if len(part.encode()) > MAX_PART_BYTES:
        return f"has a name longer than {MAX_PART_BYTES} bytes"
    if part.partition(".")[0].rstrip().casefold() in DEVICES:
        return "has the name of a device of Windows"
    return None
