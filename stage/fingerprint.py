"""Content hashes of a capture's files, remembered by size and time so that unchanged files are not read again."""

import hashlib
import json
from collections.abc import Iterable
from pathlib import Path

from stage.errors import storage
from stage.files import write_text

BLOCK = 1 << 20


class Fingerprints:
    """Content hashes of the files of one folder, with a small memory file."""

    def __init__(self, folder: Path, memory: Path) -> None:
        """Args: folder that holds the files; memory: the JSON file to remember hashes in (it need not exist)."""
        self._folder = folder
        self._memory = memory
        self._known: dict[str, list[int | str]] = {}
        try:
            remembered = json.loads(memory.read_text(encoding="utf-8"))
            self._known = {name: [*entry] for name, entry in remembered.items() if len(entry) == 3}
        except (OSError, ValueError, AttributeError, TypeError):
            pass  # a cache, and a damaged one: hashed again

    def of(self, names: Iterable[str]) -> dict[str, str]:
        """Content hash of each file.

        Raises:
            StorageError: a file cannot be read.
        """
        result: dict[str, str] = {}
        for name in names:
            path = self._folder / name
            with storage("read", path):
                stat = path.stat()
                known = self._known.get(name)
                if known is None or known[:2] != [stat.st_size, stat.st_mtime_ns]:
                    self._known[name] = [stat.st_size, stat.st_mtime_ns, digest(path)]
            result[name] = str(self._known[name][2])
        return result

    def remember(self) -> None:
        """Write the memory file."""
        write_text(self._memory, json.dumps(self._known))


def digest(path: str | Path) -> str:
    """Content hash of one file.

    Raises:
        StorageError: it cannot be read.
    """
    content = hashlib.blake2b(digest_size=16)
    with storage("read", path), open(path, "rb") as stream:
        while block := stream.read(BLOCK):
            content.update(block)
    return content.hexdigest()
