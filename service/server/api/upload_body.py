"""The body of a PATCH on its way to the part file: in bounded memory, and written while more of it arrives."""

import asyncio
from collections.abc import AsyncIterator, Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

from starlette.requests import ClientDisconnect

from service.server.storage.part_files import PartFile

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


class BodyBroken(Exception):
    """The body did not come to its end; the message is one sentence."""


class TooLong(Exception):
    """More bytes came than the length of the upload."""


class PartFileWriter:
    """Appends blocks to a part file, flushes them, and hashes them in another thread."""

    def __init__(self, part: PartFile, start: int, length: int, *, digests: list[Any], save: Callable[[int], None] | None,
                 guard: Callable[[], None]) -> None:
        """Create the writer.

        Args:
            part: cut to `start`.
            start: offset of the first byte.
            length: of the complete upload.
            digests: hashes of hashlib, which get every byte.
            save: called with offsets up to which all bytes are on the disk; None: nothing counts before the whole body is verified.
            guard: called from time to time; raises if there is no space left.
        """
        self._part, self._length, self._digests, self._save, self._guard = part, length, digests, save, guard
        self.at = self._flushed = self._saved = start
        self._saving: Future[None] | None = None

    async def take(self, pieces: list[bytes]) -> None:
        """Write and hash one block; the previous one must be finished.

        Raises:
            TooLong: the block goes beyond the end of the upload.
            StorageError: the disk refuses.
        """
        loop = asyncio.get_running_loop()
        hashing = loop.run_in_executor(None, self._hash, pieces) if self._digests else None
        try:
            await loop.run_in_executor(None, self._write, pieces)
        finally:
            if hashing is not None:
                await hashing

    def settle(self) -> None:
        """Wait for the flush that is under way, and raise its error."""
        saving, self._saving = self._saving, None
        if saving is not None:
            saving.result()

    def _hash(self, pieces: list[bytes]) -> None:
        for digest in self._digests:
            for piece in pieces:
                digest.update(piece)

    def _write(self, pieces: list[bytes]) -> None:
        size = sum(map(len, pieces))
        if self.at + size > self._length:
            raise TooLong
        self._part.append(pieces)
        self.at += size
        if self.at - self._flushed >= FLUSH_EVERY and self.at < self._length:
            self.settle()
            self._guard()
            self._flushed = self.at
            self._saving = savers.submit(self._flush, self.at)

    def _flush(self, at: int) -> None:
        self._part.sync()
        if self._save is not None and at - self._saved >= SAVE_EVERY:
            self._save(at)
            self._saved = at


async def write_body(stream: AsyncIterator[bytes], writer: PartFileWriter) -> None:
    """Write a body to a part file, block by block.

    Raises:
        BodyBroken: the client is gone or sends nothing; the bytes that were written stay.
        TooLong: more bytes came than the length of the upload.
        StorageError: the disk refuses.
    """
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
                writing, block, size = loop.create_task(writer.take(block)), [], 0
                idle.reschedule(loop.time() + IDLE_S)
    except TimeoutError:
        raise BodyBroken(f"nothing came for {IDLE_S:g} s") from None
    except ClientDisconnect:
        raise BodyBroken("the connection ended before the body did") from None
    finally:
        if writing is not None:
            await writing
        if block:
            await writer.take(block)
