"""The bytes of incomplete uploads, in part files that one request writes at a time.

With the data folder as storage, each upload has one part file there, whose lock is that of the file. With an object store, the API
processes of a service may have nothing in common but that store and the database: a request then writes to a file of its own, whose bytes
become an object of the store, a piece of the upload, before they are counted. Its lock is `writer` in the row of the upload. A writer that
was thought dead and is not counts nothing any more, as every change of the row names its writer.
"""

import hashlib
import io
import os
import secrets
import shutil
import threading
import time
from collections.abc import Sequence
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

from service.server.base import file_lock
from service.server.base.log import logger
from service.server.base.settings import Settings
from service.server.database import uploads
from service.server.database.engine import UNANSWERED, Database, message_of
from service.server.database.uploads import Row
from service.server.storage import layout
from service.server.storage.objects import Storage
from stage.errors import storage as storage_errors

SUFFIX = ".part"
COPIED = 1 << 20
"""Bytes that are copied at once."""
LEASE_S, RENEW_S = 30.0, 10.0
"""Seconds after which a writer that no longer says that it lives counts as dead, and between two times that it says so."""


class PartFileLocked(Exception):
    """Another request, of this process or another one, has locked the upload."""


class PartFile:
    """The part file of an upload, locked until it is closed. Its methods may be called from any thread, one at a time."""

    def __init__(self, path: Path, upload: Row, database: Database) -> None:
        """Open and lock the file, which is made if there is none. PartFileLocked: another request has locked it."""
        self.path, self.row, self._database = path, upload, database
        with storage_errors("write", path):
            path.parent.mkdir(parents=True, exist_ok=True)
            descriptor = file_lock.take(path, 0o640)
        if descriptor is None:
            raise PartFileLocked
        self._file = io.FileIO(descriptor, "r+")
        self._lock = threading.Lock()  # so that nobody writes to a descriptor that was closed meanwhile

    def cut(self, size: int) -> None:
        """Cut the file to `size` bytes, and append from there."""
        with self._lock, storage_errors("write", self.path):
            self._file.truncate(size)
            self._file.seek(size)

    def append(self, pieces: Sequence[bytes]) -> None:
        """Append bytes."""
        left = sum(map(len, pieces))
        with self._lock, storage_errors("write", self.path):
            while left:
                written = os.writev(self._file.fileno(), pieces)
                left -= written
                pieces = [b"".join(pieces)[written:]] if left else ()

    def sync(self) -> None:
        """Flush the file to the disk."""
        with self._lock:
            descriptor = os.dup(self._file.fileno())  # more may be written meanwhile
        try:
            with storage_errors("write", self.path):
                os.fsync(descriptor)
        finally:
            os.close(descriptor)

    def digest_into(self, digest: Any) -> None:
        """Update a hash of hashlib with all bytes."""
        with self._lock, storage_errors("read", self.path):
            self._file.seek(0)
            hashlib.file_digest(self._file, lambda: digest)

    def save(self, at: int) -> bool:
        """Count the first `at` bytes, which are on the disk; return False if the upload was deleted, or another request has it now."""
        return uploads.advance(self._database, self.row["id"], at)

    def whole(self) -> Path:
        """Return the complete file, all bytes of which have come."""
        return self.path

    def finish(self) -> bool:
        """Record that the complete file is in the storage; return as `save` does."""
        return uploads.finish(self._database, self.row["id"], self.row["length"])

    def drop(self) -> None:
        """Delete the file."""
        with storage_errors("remove", self.path):
            self.path.unlink(missing_ok=True)

    def close(self) -> None:
        """Close and unlock the file, after a write that is under way."""
        with self._lock:
            self._file.close()


class UploadParts:
    """Part files in the data folder, which all API processes of a service share."""

    saves_while_writing = True
    """True if bytes can be counted before a request has ended."""

    def __init__(self, folder: Path, database: Database) -> None:
        self._folder, self._database = folder, database

    def open(self, upload: Row) -> PartFile:
        """Open and lock the part file of an upload. PartFileLocked: another request has locked it."""
        return PartFile(self._path(upload["id"]), upload, self._database)

    def size(self, upload: Row) -> int:
        """Return the number of bytes that are kept of an upload, of which some may not be counted yet."""
        try:
            return self._path(upload["id"]).stat().st_size
        except FileNotFoundError:
            return 0

    def discard(self, upload: str) -> None:
        """Delete what is kept of an upload that was deleted, whether or not it is locked."""
        with storage_errors("remove", self._path(upload)):
            self._path(upload).unlink(missing_ok=True)

    def expire(self, before: float) -> int:
        """Delete uploads that were not continued since a time and that no request has locked, and bytes from before it without an upload.

        Return the number of uploads.
        """
        removed = 0
        for row in uploads.untouched(self._database, before):
            with suppress(PartFileLocked), closing(self.open(row)) as part:
                if uploads.drop_untouched(self._database, row["id"], before):
                    part.drop()
                    removed += 1
        self._drop_leftovers(before)
        return removed

    def _drop_leftovers(self, before: float) -> None:
        """Delete the part files, and copies of them that were sent, that were not written since a time and have no upload."""
        old = dict[Path, str]()
        for path in self._folder.glob(f"*{SUFFIX}*"):
            with suppress(FileNotFoundError):
                if path.stat().st_mtime < before:
                    old[path] = path.name.partition(SUFFIX)[0]
        unfinished = uploads.unfinished_of(self._database, set(old.values()))
        for path in (path for path, name in old.items() if name not in unfinished):
            with storage_errors("remove", path):
                path.unlink(missing_ok=True)

    def _path(self, name: str) -> Path:
        return self._folder / f"{name}{SUFFIX}"


class StoredPart(PartFile):
    """The bytes that one request adds to an upload, behind the pieces in the object store."""

    def __init__(self, path: Path, upload: Row, database: Database, parts: "StoredParts", writer: str) -> None:
        super().__init__(path, upload, database)
        self._parts, self._writer = parts, writer
        self._begin = sum(length for _, length in upload["pieces"])  # where the bytes of this file follow those of the pieces
        self._piece, self._whole = path.with_name(f"{path.name}.piece"), path.with_name(f"{path.name}.whole")  # while they are sent

    def cut(self, size: int) -> None:
        """Cut the upload to `size` bytes: to none, or behind the pieces."""
        if size < self._begin:
            self._begin = 0
        super().cut(size - self._begin)

    def digest_into(self, digest: Any) -> None:
        """Update a hash with the pieces, and with this file."""
        for path in self._fetched() if self._begin else ():
            with storage_errors("read", path), open(path, "rb") as piece:
                hashlib.file_digest(piece, lambda: digest)
        super().digest_into(digest)

    def save(self, at: int) -> bool:
        """Send the bytes that this request has added as a piece, and count them."""
        pieces = [tuple(piece) for piece in self.row["pieces"]] if self._begin else []
        if at > self._begin:
            name = f"{self._begin:016d}-{self._writer}"
            with storage_errors("write", self._piece):
                shutil.copyfile(self.path, self._piece)
                os.truncate(self._piece, at - self._begin)
            self._parts.storage.put(self._piece, layout.pieces(self.row["id"]), name)
            pieces.append((name, at - self._begin))
        return uploads.advance(self._database, self.row["id"], at, writer=self._writer, pieces=pieces)

    def whole(self) -> Path:
        """Return the file of the request if it began at the first byte, else the pieces and it in one file."""
        if self._begin == 0:
            return self.path
        with storage_errors("write", self._whole), open(self._whole, "wb") as whole:
            for path in (*self._fetched(), self.path):
                with open(path, "rb") as piece:
                    shutil.copyfileobj(piece, whole, COPIED)
            whole.flush()
            os.fsync(whole.fileno())
        return self._whole

    def finish(self) -> bool:
        """Record that the upload is complete, and delete its pieces."""
        done = uploads.finish(self._database, self.row["id"], self.row["length"], writer=self._writer)
        if done and self.row["pieces"]:
            self._parts.discard(self.row["id"])
        return done

    def drop(self) -> None:
        """Delete this file and the pieces."""
        super().drop()
        self._parts.discard(self.row["id"])

    def close(self) -> None:
        """Delete this file, whose bytes are in the store if they count, and release the upload."""
        for path in (self.path, self._piece, self._whole):
            path.unlink(missing_ok=True)
        super().close()
        self._parts.release(self.row["id"], self._writer)

    def _fetched(self) -> list[Path]:
        """Return copies of the pieces of the upload, in order."""
        names = [name for name, _ in self.row["pieces"]]
        folder = self._parts.storage.local(layout.pieces(self.row["id"]), names)
        return [folder / name for name in names]


class StoredParts(UploadParts):
    """Pieces of uploads in an object store."""

    saves_while_writing = False

    def __init__(self, folder: Path, database: Database, storage: Storage) -> None:
        super().__init__(folder, database)
        self.storage = storage
        self._lock = threading.Lock()
        self._writers = set[str]()
        self._renewing = False

    def open(self, upload: Row) -> PartFile:
        """Lock the row of the upload, and make a file for the bytes that come."""
        writer, now = secrets.token_hex(8), time.time()
        if not uploads.take(self._database, upload["id"], writer, now=now, until=now + LEASE_S):
            raise PartFileLocked
        self._keep(writer)
        try:
            row = uploads.find(self._database, upload["id"], upload["project"]) or upload  # as it is under the lock
            return StoredPart(self._path(f"{row['id']}-{writer}"), row, self._database, self, writer)
        except BaseException:
            self.release(upload["id"], writer)
            raise

    def size(self, upload: Row) -> int:
        """Return the number of bytes of the pieces, which are those that count."""
        return int(upload["received"])

    def discard(self, upload: str) -> None:
        """Delete the pieces."""
        self.storage.remove(layout.pieces(upload))

    def release(self, upload: str, writer: str) -> None:
        """Let others add to the upload."""
        with self._lock:
            self._writers.discard(writer)
        uploads.release(self._database, upload, writer)

    def _drop_leftovers(self, before: float) -> None:
        """Delete pieces that are older than a time and have no upload, and such files of requests."""
        old = {found.name.partition("/")[0] for found in self.storage.files(layout.PIECES) if found.modified_at < before}
        for upload in old - uploads.unfinished_of(self._database, old):
            self.discard(upload)
        super()._drop_leftovers(before)

    def _keep(self, writer: str) -> None:
        """Renew the lock of a writer until it is released."""
        with self._lock:
            self._writers.add(writer)
            if not self._renewing:
                self._renewing = True
                threading.Thread(target=self._renew, name="relit-uploads", daemon=True).start()

    def _renew(self) -> None:
        while True:
            time.sleep(RENEW_S)
            with self._lock:
                writers = list(self._writers)
                self._renewing = bool(writers)
            if not writers:
                return
            try:
                uploads.renew(self._database, writers, time.time() + LEASE_S)
            except UNANSWERED as error:
                logger.warning("locks of uploads are not renewed", error=message_of(error))


def open_upload_parts(settings: Settings, database: Database, storage: Storage) -> UploadParts:
    """Return the part files of the service that the settings describe."""
    if settings.storage_url is None:
        return UploadParts(settings.part_files, database)
    return StoredParts(settings.part_files, database, storage)
