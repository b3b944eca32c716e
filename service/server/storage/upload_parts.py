"""The bytes of incomplete uploads, and the request that may add to them.

With the data folder as storage, each upload has one part file there, whose lock is that of the file. With an object store, the API
processes of a service may have nothing in common but that store and the database: a request then writes to a file of its own, whose bytes
become an object of the store, a piece of the upload, before they are counted. Its lock is `writer` in the row of the upload. A writer that
was thought dead and is not counts nothing any more, as every change of the row names its writer.
"""

import os
import secrets
import shutil
import threading
import time
from pathlib import Path
from typing import Any, TypeAlias

from service.server.base.log import logger
from service.server.base.settings import Settings
from service.server.database import uploads
from service.server.database.engine import UNANSWERED, Database, message_of
from service.server.database.uploads import Row
from service.server.storage import layout
from service.server.storage.objects import Storage
from service.server.storage.part_files import READ, PartFile, PartFileLocked, leftovers, part_files_folder, stored_bytes
from stage.errors import storage as storage_errors

LEASE_S, RENEW_S = 30.0, 10.0
"""Seconds after which a writer that no longer says that it lives counts as dead, and between two times that it says so."""


UploadParts: TypeAlias = "FolderParts | StoredParts"
"""The bytes of all incomplete uploads."""


class FolderParts:
    """Part files in the data folder, which all API processes of a service share."""

    saves_while_writing = True
    """True if bytes can be counted before a request has ended."""

    def __init__(self, folder: Path, database: Database) -> None:
        self._folder, self._database = folder, database

    def open(self, upload: Row) -> PartFile:
        """Open and lock the part file of an upload, as `PartFile.open` does."""
        return PartFile.open(self._folder, upload["id"])

    def save(self, part: PartFile, upload: str, at: int) -> bool:
        """Count the first `at` bytes, which are on the disk; return False if the upload was deleted, or another request has it now."""
        return uploads.advance(self._database, upload, at)

    def whole(self, part: PartFile) -> Path:
        """Return the complete file, all bytes of which have come."""
        return part.path

    def finish(self, part: PartFile, upload: str, length: int) -> bool:
        """Record that the complete file is in the storage; return as `save` does."""
        return uploads.finish(self._database, upload, length)

    def size(self, upload: Row) -> int:
        """Return the number of bytes that are kept of an upload, of which some may not be counted yet."""
        return stored_bytes(self._folder, upload["id"])

    def discard(self, upload: str) -> None:
        """Delete what is kept of an upload that was deleted, whether or not it is locked."""
        PartFile.discard(self._folder, upload)

    def expire(self, before: float) -> int:
        """Delete rows that no request has locked, with their part files, and part files without a row."""
        removed = _drop_untouched(self, self._database, before)
        _drop_leftovers(self._database, self._folder, before)
        return removed


class StoredPart(PartFile):
    """The bytes that one request adds to an upload, behind the pieces in the object store."""

    writer: str
    pieces: "StoredParts"
    row: Row
    begin: int
    """Bytes of the pieces, behind which those of this file follow."""

    @property
    def piece(self) -> Path:
        """Path of a copy, while it is sent."""
        return self.path.with_name(f"{self.path.name}.piece")

    @property
    def whole(self) -> Path:
        """Path of the complete file, while it is sent."""
        return self.path.with_name(f"{self.path.name}.whole")

    @property
    def size(self) -> int:
        """Bytes of the pieces and of this file."""
        return self.begin + super().size

    def cut(self, size: int) -> None:
        """Cut the upload to `size` bytes: to none, or behind the pieces."""
        if size < self.begin:
            self.begin = 0
        super().cut(size - self.begin)

    def digest_into(self, digest: Any) -> None:
        """Update a hash with the pieces, and with this file."""
        if self.begin:
            for path in self.pieces.fetched(self.row):
                with storage_errors("read", path), open(path, "rb") as piece:
                    while block := piece.read(READ):
                        digest.update(block)
        super().digest_into(digest)

    def drop(self) -> None:
        """Delete this file and the pieces."""
        super().drop()
        self.pieces.discard(self.row["id"])

    def close(self) -> None:
        """Delete this file, whose bytes are in the store if they count, and release the upload."""
        for path in (self.path, self.piece, self.whole):
            path.unlink(missing_ok=True)
        super().close()
        self.pieces.release(self.row["id"], self.writer)


class StoredParts:
    """Pieces of uploads in an object store."""

    saves_while_writing = False

    def __init__(self, folder: Path, database: Database, storage: Storage) -> None:
        self._folder, self._database, self._storage = folder, database, storage
        self._lock = threading.Lock()
        self._writers = set[str]()
        self._renewing = False

    def open(self, upload: Row) -> StoredPart:
        """Lock the row of the upload, and make a file for the bytes that come."""
        writer, now = secrets.token_hex(8), time.time()
        if not uploads.take(self._database, upload["id"], writer, now=now, until=now + LEASE_S):
            raise PartFileLocked
        self._keep(writer)
        try:
            part = StoredPart.open(self._folder, f"{upload['id']}-{writer}")
        except BaseException:
            self.release(upload["id"], writer)
            raise
        part.writer, part.pieces = writer, self
        part.row = uploads.find(self._database, upload["id"], upload["project"]) or upload
        part.begin = sum(length for _, length in part.row["pieces"])
        return part

    def save(self, part: PartFile, upload: str, at: int) -> bool:
        """Send the bytes that this request has added as a piece, and count them."""
        assert isinstance(part, StoredPart)
        pieces = [tuple(piece) for piece in part.row["pieces"]] if part.begin else []
        if at > part.begin:
            name = f"{part.begin:016d}-{part.writer}"
            with storage_errors("write", part.piece):
                shutil.copyfile(part.path, part.piece)
                os.truncate(part.piece, at - part.begin)
            self._storage.put(part.piece, layout.pieces(upload), name)
            pieces.append((name, at - part.begin))
        return uploads.advance(self._database, upload, at, writer=part.writer, pieces=pieces)

    def whole(self, part: PartFile) -> Path:
        """Return the file of the request if it began at the first byte, else the pieces and it in one file."""
        assert isinstance(part, StoredPart)
        if part.begin == 0:
            return part.path
        with storage_errors("write", part.whole), open(part.whole, "wb") as whole:
            for path in (*self.fetched(part.row), part.path):
                with open(path, "rb") as piece:
                    shutil.copyfileobj(piece, whole, READ)
            whole.flush()
            os.fsync(whole.fileno())
        return part.whole

    def finish(self, part: PartFile, upload: str, length: int) -> bool:
        """Record that the upload is complete, and delete its pieces."""
        assert isinstance(part, StoredPart)
        done = uploads.finish(self._database, upload, length, writer=part.writer)
        if done and part.row["pieces"]:
            self.discard(upload)
        return done

    def size(self, upload: Row) -> int:
        """Return the number of bytes of the pieces, which are those that count."""
        return int(upload["received"])

    def discard(self, upload: str) -> None:
        """Delete the pieces."""
        self._storage.remove(layout.pieces(upload))

    def expire(self, before: float) -> int:
        """Delete rows that no request has locked, with their pieces, and pieces and files without a row."""
        removed = _drop_untouched(self, self._database, before)
        old = {found.name.partition("/")[0] for found in self._storage.files(layout.PIECES) if found.modified_at < before}
        for upload in old - uploads.unfinished_of(self._database, old):
            self.discard(upload)
        _drop_leftovers(self._database, self._folder, before)
        return removed

    def fetched(self, upload: Row) -> list[Path]:
        """Return copies of the pieces of an upload, in order."""
        names = [name for name, _ in upload["pieces"]]
        folder = self._storage.local(layout.pieces(upload["id"]), names)
        return [folder / name for name in names]

    def release(self, upload: str, writer: str) -> None:
        """Let others add to the upload."""
        with self._lock:
            self._writers.discard(writer)
        uploads.release(self._database, upload, writer)

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


def _drop_untouched(parts: UploadParts, database: Database, before: float) -> int:
    """Delete the uploads that were not continued since a time and that no request has locked; return their number."""
    removed = 0
    for row in uploads.untouched(database, before):
        try:
            part = parts.open(row)
        except PartFileLocked:
            continue
        with part:
            if uploads.drop_untouched(database, row["id"], before):
                part.drop()
                removed += 1
    return removed


def _drop_leftovers(database: Database, folder: Path, before: float) -> None:
    """Delete the part files that were not written since a time and have no upload."""
    old = set(leftovers(folder, before))
    for identifier in old - uploads.unfinished_of(database, old):
        PartFile.discard(folder, identifier)


def open_upload_parts(settings: Settings, database: Database, storage: Storage) -> UploadParts:
    """Return the part files of the service that the settings describe."""
    folder = part_files_folder(settings)
    return FolderParts(folder, database) if settings.storage_url is None else StoredParts(folder, database, storage)
