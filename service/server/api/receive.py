"""The body of one PATCH, from the network to the part file: in bounded memory, with the disk at work while the network is."""

import asyncio
import hashlib
import threading
from collections import OrderedDict
from collections.abc import AsyncIterator, Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

from starlette.requests import ClientDisconnect

from service.server.storage.parts import Part

BLOCK = 1 << 20
"""Bytes that are written at once; two of them are in memory."""
MAX_PIECES = 512
"""Of a block: the system writes 1024 at once, and a client that sends byte by byte fills no memory with their heads."""
FLUSH_EVERY = 16 << 20
"""Bytes after which the disk is told to have them for sure, while more come: little is left to wait for at the end."""
SAVE_EVERY = 64 << 20
"""Bytes after which it is also noted that it has them."""
IDLE_S = 60.0
"""Without a byte for this long the client is taken for gone, so that it can come again: the part is locked until then."""
KEPT = 1024
"""Running hashes of uploads that are kept for their next PATCH."""

savers = ThreadPoolExecutor(4, thread_name_prefix="relit-save")
"""They wait for the disk, beside the threads that write."""


class Broken(Exception):
    """The body did not come to its end; one sentence."""


class TooLong(Exception):
    """More bytes came than the upload has."""


class Writer:
    """Appends blocks to a part and has them saved on the way; beside that, hashes them. Each of the two in its own thread."""

    def __init__(self, part: Part, start: int, length: int, *, digests: list[Any], save: Callable[[int], None] | None,
                 guard: Callable[[], None]) -> None:
        """Prepare.

        Args:
            part: cut to `start`.
            start: offset of the first byte.
            length: that the upload will have.
            digests: of hashlib, fed with every byte.
            save: told of every offset up to which all bytes are on the disk; None: they are not trusted until the end of the body.
            guard: asked at times whether there is space left; raises where there is not.
        """
        self._part, self._length, self._digests, self._save, self._guard = part, length, digests, save, guard
        self.at = self._flushed = self._saved = start
        self._saving: Future[None] | None = None

    async def take(self, pieces: list[bytes]) -> None:
        """Write and hash one block; the one before must be done.

        Raises:
            TooLong: it goes beyond the end of the upload.
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
        """Wait for what is being saved; raises what went wrong with it."""
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


async def pour(stream: AsyncIterator[bytes], writer: Writer) -> None:
    """Write a body, block after block.

    Raises:
        Broken: the client is gone, or sends nothing; what was written stays.
        TooLong: more came than the upload has.
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
        raise Broken(f"nothing came for {IDLE_S:g} s") from None
    except ClientDisconnect:
        raise Broken("the connection ended before the body did") from None
    finally:
        if writing is not None:
            await writing
        if block:
            await writer.take(block)


class RunningHashes:
    """SHA-256 of what has come of each upload: a whole file need not be read again at its end. Those of a process before are lost."""

    def __init__(self) -> None:
        """Empty."""
        self._kept: OrderedDict[str, tuple[int, Any]] = OrderedDict()
        self._lock = threading.Lock()

    def take(self, upload: str, start: int) -> Any | None:
        """The hash of the first bytes, to be fed with those that follow; None: not known."""
        with self._lock:
            at, digest = self._kept.pop(upload, (None, None))
        if start == 0:
            return hashlib.sha256()
        return digest if at == start else None

    def keep(self, upload: str, at: int, digest: Any) -> None:
        """For the next PATCH."""
        with self._lock:
            self._kept[upload] = (at, digest)
            while len(self._kept) > KEPT:
                self._kept.popitem(last=False)
