"""One PATCH of an upload: its body is appended to the part file, verified, and only then counted.

The body is in bounded memory on its way to the part file, and is written while more of it arrives.
"""

import asyncio
import contextlib
import hashlib
import hmac
import os
import time
from collections.abc import AsyncIterator
from concurrent.futures import Future, ThreadPoolExecutor

from starlette.requests import ClientDisconnect

from service.server.api.context import FOR_UPLOAD, Service, require_space, require_valid
from service.server.api.problems import ApiError
from service.server.api.tus import Checksum
from service.server.base.log import logger
from service.server.base.safe_names import shown
from service.server.database import intakes, uploads
from service.server.database.keys import Caller
from service.server.database.uploads import Row
from service.server.storage import layout
from service.server.storage.upload_parts import PartFileLocked

BUSY_RETRY_S = 1
BLOCK = 1 << 20
"""Bytes that are written at once; two such blocks are in memory."""
MAX_PIECES = 512
"""Pieces of a block at most: the system writes 1024 at once, and a client that sends single bytes must not fill the memory."""
FLUSH_EVERY = 16 << 20
"""Bytes after which the file is flushed to the disk while more arrive, so that little is left to flush at the end."""
SAVE_EVERY = 64 << 20
"""Bytes after which the flushed offset is also recorded."""
IDLE_S = 60.0
"""Seconds without a byte after which the client counts as gone; until then the part file is locked, and it cannot continue."""

savers = ThreadPoolExecutor(4, thread_name_prefix="relit-save")
"""Threads that flush, beside those that write."""
being_written: set[str] = set()
"""Identifiers of the uploads that a PATCH of this process has locked."""


class UploadPatch:
    """A PATCH of an upload, whose part file is locked until `close`.

    The methods other than `write` wait for the disk or the database: call them from a thread.
    """

    def __init__(self, service: Service, caller: Caller, upload: Row, *, offset: int, checksum: Checksum | None) -> None:
        """Lock the part file at the offset from which the client continues, and cut off bytes that were not counted."""
        self._service, self._caller, self._row, self._checksum = service, caller, upload, checksum
        self._digest = None if checksum is None else hashlib.new(checksum.algorithm)
        self._saving: Future[None] | None = None
        try:
            self._part = service.parts.open(upload)
        except PartFileLocked:
            raise _locked(upload) from None
        being_written.add(upload["id"])
        try:
            self._begin(offset)
        except BaseException:
            self.close()
            raise

    def _begin(self, offset: int) -> None:
        self._row = row = self._still_there()  # as it is under the lock
        start = self._at = self._flushed = self._saved = received_of(self._service, row)
        if row["done"]:
            self._part.drop()  # opening it made an empty file
        if offset != start:
            raise ApiError("conflict", f"Upload-Offset: is {offset}, {start} bytes are here", headers={"Upload-Offset": str(start)})
        if not row["done"]:
            require_space(self._service, FOR_UPLOAD)
            self._part.cut(start)
        # a file that comes in one request is hashed meanwhile, one that comes in several is read when it is complete
        self._whole = hashlib.sha256() if row["sha256"] is not None and not row["done"] and start == 0 else None
        self._digests = [digest for digest in (self._digest, self._whole) if digest is not None]

    async def write(self, stream: AsyncIterator[bytes]) -> str | None:
        """Write a body to the part file, block by block; return why it did not come to its end. What has come is written in any case."""
        loop = asyncio.get_running_loop()
        writing: asyncio.Task[None] | None = None
        block, size = list[bytes](), 0
        try:
            async with asyncio.timeout(IDLE_S) as idle:
                async for chunk in stream:
                    block.append(chunk)
                    size += len(chunk)
                    if size < BLOCK and len(block) < MAX_PIECES:
                        idle.reschedule(loop.time() + IDLE_S)
                        continue
                    idle.reschedule(None)  # a slow disk is not the client's fault
                    if writing is not None:
                        await writing
                    writing, block, size = loop.create_task(self._take(block)), [], 0
                    idle.reschedule(loop.time() + IDLE_S)
        except TimeoutError:
            return f"nothing came for {IDLE_S:g} s"
        except ClientDisconnect:
            return "the connection ended before the body did"
        finally:
            if writing is not None:
                await writing
            if block:
                await self._take(block)
        return None

    def end(self, broken: str | None) -> Row:
        """Verify and count the bytes that came, and return the row of the upload as it is now; `broken` is what `write` has returned."""
        if self._row["done"]:
            return self._row
        self._settle()
        try:
            require_valid(self._service, self._caller)
        except ApiError:
            self.give_up()
            raise
        if self._checksum is not None and self._digest is not None:
            right = hmac.compare_digest(self._digest.digest(), self._checksum.digest)
            if broken is not None or not right:
                self.give_up()
                raise ApiError("bad-request", broken) if broken is not None else ApiError(
                    "checksum-mismatch", "Upload-Checksum: the body has another: its bytes are dropped")
        self._part.sync()
        if self._at == self._row["length"]:
            self._complete()
        else:
            self._save(self._at)
            if broken is not None:
                raise ApiError("bad-request", broken)
        return {**self._row, "received": self._at, "done": self._at == self._row["length"], "touched_at": time.time()}

    def give_up(self) -> None:
        """Cut off bytes that were not counted; if the disk refuses that, the next PATCH does it."""
        with contextlib.suppress(Exception):
            self._settle()
        with contextlib.suppress(OSError):
            self._part.cut(self._saved)

    def close(self) -> None:
        """Unlock the part file."""
        self._part.close()
        being_written.discard(self._row["id"])

    async def _take(self, pieces: list[bytes]) -> None:
        """Write and hash one block; the previous one must be finished."""
        loop = asyncio.get_running_loop()
        hashing = loop.run_in_executor(None, self._hash, pieces) if self._digests else None
        try:
            await loop.run_in_executor(None, self._append, pieces)
        finally:
            if hashing is not None:
                await hashing

    def _hash(self, pieces: list[bytes]) -> None:
        for digest in self._digests:
            for piece in pieces:
                digest.update(piece)

    def _append(self, pieces: list[bytes]) -> None:
        size = sum(map(len, pieces))
        if self._at + size > self._row["length"]:
            raise too_long(self._row)
        self._part.append(pieces)
        self._at += size
        if self._at - self._flushed >= FLUSH_EVERY and self._at < self._row["length"]:
            self._settle()
            require_space(self._service, FOR_UPLOAD)
            require_valid(self._service, self._caller)
            self._flushed = self._at
            self._saving = savers.submit(self._flush, self._at)

    def _flush(self, at: int) -> None:
        self._part.sync()
        # with a checksum nothing counts before the whole body is verified
        if self._checksum is None and self._service.parts.saves_while_writing and at - self._saved >= SAVE_EVERY:
            self._save(at)

    def _settle(self) -> None:
        """Wait for the flush that is under way, and raise its error."""
        saving, self._saving = self._saving, None
        if saving is not None:
            saving.result()

    def _save(self, at: int) -> None:
        self._saved = at
        if not self._part.save(at):
            self._gone()

    def _complete(self) -> None:
        row, service = self._row, self._service
        if row["sha256"] is not None:
            if self._whole is None:
                self._whole = hashlib.sha256()
                self._part.digest_into(self._whole)
            if self._whole.hexdigest() != row["sha256"]:
                self._part.cut(0)
                self._save(0)
                raise ApiError("checksum-mismatch", f"{shown(row['path'])}: has another sha256 than was said: all its bytes are dropped")
        self._still_there()
        prefix = layout.intake(row["project"], row["intake"])
        service.storage.put(self._part.whole(), prefix, row["path"])
        if not self._part.finish():
            if intakes.find(service.database, row["intake"], row["project"]) is None:  # which finds no row of what it would have to delete
                service.storage.remove(prefix)
            self._gone()
        logger.info("upload complete", upload=row["id"], intake=row["intake"], path=row["path"], length=row["length"])

    def _still_there(self) -> Row:
        row = uploads.find(self._service.database, self._row["id"], self._row["project"])
        return self._gone() if row is None else row

    def _gone(self) -> Row:
        if uploads.find(self._service.database, self._row["id"], self._row["project"]) is not None:  # of another writer, now
            raise _locked(self._row)
        self._part.drop()
        raise ApiError("not-found", f"{self._row['id']}: was deleted")


def _locked(row: Row) -> ApiError:
    return ApiError("locked", f"{row['id']}: another request is adding to it", headers={"Retry-After": str(BUSY_RETRY_S)})


def too_long(row: Row) -> ApiError:
    """Return the refusal of a body with more bytes than the length of the upload."""
    return ApiError("too-large", f"the body goes beyond the {row['length']} bytes that Upload-Length said")


def received_of(service: Service, row: Row) -> int:
    """Return the bytes of an upload that the client need not send again: none, if its part file lacks some of those that were counted."""
    received = int(row["received"])
    return received if row["done"] or service.parts.size(row) >= received else 0


def settled(service: Service, row: Row) -> Row:
    """Return the row of an upload, corrected if the service ended after it moved the complete file and before it recorded that."""
    if row["done"] or service.parts.size(row) >= row["received"]:
        return row
    # not an older file of this path: that was deleted when the upload began
    moved = service.storage.open(layout.intake(row["project"], row["intake"]), row["path"])
    if moved is None:
        return row
    os.close(moved.descriptor)
    if moved.size != row["length"] or not uploads.finish(service.database, row["id"], row["length"]):
        return row
    return {**row, "received": row["length"], "done": True}
