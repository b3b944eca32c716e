"""Content hashes of files, remembered by size and modification time so that unchanged files are not read again."""

import hashlib
import json
import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from stage import inputs
from stage.errors import storage
from stage.files import write_text

BLOCK = 1 << 20
"""The bytes of a file that are read and hashed at one time."""


class Fingerprints:
    """The content hashes of the files of one folder, which are kept in a JSON file between runs."""

    def __init__(self, folder: Path, memory: Path, progress: Callable[[float], None] = lambda _: None) -> None:
        """Load the hashes that an earlier run has kept.
        `progress`: called with the fraction of the files of each call of `of` that are done."""
        self._folder = folder
        self._memory = memory
        self._progress = progress
        self._known: dict[str, list[int | str]] = {}
        try:
            remembered = json.loads(memory.read_text(encoding="utf-8"))
            self._known = {name: [*entry] for name, entry in remembered.items() if len(entry) == 3}
        except (OSError, ValueError, AttributeError, TypeError, RecursionError):
            pass  # damaged hashes are computed again

    def of(self, names: Iterable[str]) -> dict[str, str]:
        """Return the content hash of each file by its name."""
        wanted = list(dict.fromkeys(names))
        with ThreadPoolExecutor(os.cpu_count(), thread_name_prefix="relit-fingerprints") as pool:
            found = dict[str, str]()
            for name, known in zip(wanted, pool.map(self._of, wanted), strict=True):
                found[name] = known
                self._progress(len(found) / len(wanted))
            return found

    def _of(self, name: str) -> str:
        path = self._folder / name
        with storage("read", path):
            stat = path.stat()
            known = self._known.get(name)
            if known is None or known[:2] != [stat.st_size, stat.st_mtime_ns]:
                known = self._known[name] = [stat.st_size, stat.st_mtime_ns, digest(path)]
        return str(known[2])

    def remember(self) -> None:
        """Write the hashes to the JSON file."""
        write_text(self._memory, json.dumps(self._known))


def digest(path: str | Path) -> str:
    """Return the content hash of one file: BLAKE2b with 16 bytes, in hexadecimal digits."""
    content = hashlib.blake2b(digest_size=16)
    with inputs.opened(path) as source, storage("read", path):
        while block := source.file.read(BLOCK):
            content.update(block)
    return content.hexdigest()


def combined(digests: Iterable[str]) -> str:
    """Return the content hash of several files from theirs, in their order."""
    return hashlib.blake2b("".join(digests).encode(), digest_size=16).hexdigest()
