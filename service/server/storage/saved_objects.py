"""Objects of an object store in a backup: which there were, copies of them, and whether they are still there."""

import os
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

from service.server.storage import layout
from service.server.storage.bucket import Bucket, Object
from service.server.storage.folder import REMOVED, is_shown
from service.server.storage.objects import TRANSFERS
from stage.errors import StorageError, storage

PROJECTS = "projects"
TRIES = 5
"""Times that an object is fetched that is replaced meanwhile."""


class Differences(NamedTuple):
    """Objects of a backup that the store has no longer as they were."""

    missing: list[str]
    changed: list[str]
    """Objects with another size or another ETag."""


def present(bucket: Bucket, *, pieces: bool) -> dict[str, Object]:
    """Return the objects of captures, results and, with `pieces`, incomplete uploads by path, without those that are being deleted."""
    removed = tuple(f"{found.path.removeprefix(f'{REMOVED}/')}/" for found in bucket.below(REMOVED))
    found = [*bucket.below(PROJECTS), *(bucket.below(layout.PIECES) if pieces else ())]
    return {each.path: each for each in found
            if is_shown(each.path) and not each.path.startswith(removed) and not layout.is_shared(each.path)}


def save(bucket: Bucket, folder: Path) -> dict[str, Object]:
    """Copy the objects into a folder, and return those that were copied; one that is deleted meanwhile is left out."""
    def fetch(found: Object) -> Object | None:
        target = folder / found.path
        with storage("write", target):
            target.parent.mkdir(parents=True, exist_ok=True)
        for left in reversed(range(TRIES)):
            try:
                bucket.fetch(found, target, lambda: None)
                break
            except (StorageError, FileNotFoundError):
                again = bucket.find(found.path)
                if again is None:
                    target.unlink(missing_ok=True)
                    return None
                if again.version == found.version or not left:
                    raise
                found = again
        with storage("write", target), open(target, "rb") as written:
            os.fsync(written.fileno())
            target.chmod(0o600)
        return found

    with ThreadPoolExecutor(TRANSFERS, thread_name_prefix="relit-backup") as pool:
        return {found.path: found for found in pool.map(fetch, present(bucket, pieces=True).values()) if found is not None}


def compare(bucket: Bucket, wanted: Mapping[str, tuple[int, str]]) -> Differences:
    """Compare the objects of the store with those of a backup, each with its size and ETag."""
    found = present(bucket, pieces=True)
    return Differences([path for path in wanted if path not in found],
                       [path for path, entry in wanted.items() if path in found and (found[path].size, found[path].version) != entry])


def send(bucket: Bucket, folder: Path, paths: list[str]) -> None:
    """Send copies into the store."""
    with ThreadPoolExecutor(TRANSFERS, thread_name_prefix="relit-restore") as pool:
        for _ in pool.map(lambda path: bucket.send(folder / path, path, lambda: None), paths):
            pass
