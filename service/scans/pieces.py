"""Work on many scans in pieces, each of which is done once and kept: by the threads of one process, or by several workers.

All workers of a run do the same and in the same order, except that every piece is made by one of them; what it made is bytes under the
name of its phase and its own, from where all read it. A run that is begun again finds the pieces that are done. A digest of what a phase
follows from is part of its name, so that nothing of another run is taken for it.
"""

import time
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from pathlib import Path

from service.sharing.sharing import LOOK_S, PieceStore, agree, digest, opened, sealed
from stage.errors import storage
from stage.files import replacing
from stage.results.depth_maps import DEPTH_FILE

DONE, CLAIM = ".done", ".claim"
"""Suffixes of the names under which it is kept that a piece is done, and who does it."""


def stamps(places: Sequence[Path], *, timed: bool) -> tuple[tuple[int, int], ...]:
    """Return the size and the time of the last change of the files of scans, by which a run that is begun again knows them.

    Times do not count if workers on several machines have copies of other times.
    """
    files = [path for place in places for path in (place, place / DEPTH_FILE) if path.is_file()]
    return tuple((path.stat().st_size, path.stat().st_mtime_ns if timed else 0) for path in files)


class FolderPieces:
    """Pieces as files of a folder, which one process makes."""

    def __init__(self, folder: Path) -> None:
        """Keep the pieces in a folder, which need not exist."""
        self._folder = folder

    def read(self, name: str) -> bytes | None:
        """Return what was stored under a name, or None."""
        try:
            return (self._folder / name).read_bytes()
        except FileNotFoundError:
            return None

    def write(self, name: str, content: bytes) -> None:
        """Store something under a name, whole or not at all."""
        path = self._folder / name
        with storage("write", path):
            path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as temporary:
            temporary.write_bytes(content)

    def claim(self, name: str) -> bool:
        """Return that this process is to do a piece."""
        return True


class SharedPieces:
    """The part of one worker in a run."""

    def __init__(self, store: PieceStore, *, leads: bool = True, invite: Callable[[int], None] = lambda pieces: None) -> None:
        """Create the part of a worker.
        `leads`: whether this worker has the job; it alone says what a phase follows from. `invite`: called with the number of pieces
        before each phase, to ask other workers."""
        self._store, self._leads, self._invite = store, leads, invite
        self._run, self._phases, self._has_agreed = "", 0, False

    @property
    def leads(self) -> bool:
        """Return whether this worker has the job."""
        return self._leads

    def identify(self, *given: object) -> None:
        """Take note of what the run is made from: workers with other inputs, options or programs share nothing."""
        self._run = digest(given)

    def do(self, name: str, pieces: Sequence[str], make: Callable[[str], bytes], *, follows_from: object = None, threads: int = 1,
           advance: Callable[[int], None] = lambda done: None) -> Callable[[str], bytes]:
        """Make the pieces of a phase that are not there and that no other worker makes, and wait for those of others.

        Args:
            name: of the phase; phases of one run follow each other alike for all workers.
            pieces: their names.
            make: returns the content of a piece, which depends on its name, on the run, and on `follows_from` alone. It is called by
                several threads.
            follows_from: numbers, strings, arrays and tuples of these.
            threads: pieces that this worker makes at one time.
            advance: told how many pieces are done, now and then also without a further one. An exception of it ends the work.

        Returns:
            The function that returns the content of a piece.

        Raises:
            DivergedError: this worker does not lead, and the phase follows from something else than that of the worker that leads.
        """
        self._phases += 1
        follows = digest((name, follows_from))
        phase = f"{self._run[:16]}/{self._phases:03d}-{name}"
        folder = f"{phase}-{follows[:16]}"
        agree(self._store, phase, follows, leads=self._leads, is_begun=not self._has_agreed)
        self._has_agreed = True
        if len(pieces) > 1:
            self._invite(len(pieces))
        left = list(pieces) if self._leads else list(pieces)[::-1]  # who helps begins at the other end: neighbours read the same scans
        running: dict[Future[None], str] = {}

        def made(piece: str) -> None:
            self._made(f"{folder}/{piece}", piece, make)
            self._store.write(f"{folder}/{piece}{DONE}", b"")

        def content(piece: str) -> bytes:
            """Return what is kept of a piece, which is made once more if its file was damaged or removed."""
            name = f"{folder}/{piece}"
            return opened(self._store.read(name)) or self._made(name, piece, make)

        with ThreadPoolExecutor(threads) as pool:
            try:
                while left or running:
                    advance(len(pieces) - len(left) - len(running))
                    begun = len(running)
                    left = self._begin(left, folder, threads, lambda piece: running.update({pool.submit(made, piece): piece}), running)
                    if running:
                        ended, _ = wait(running, timeout=LOOK_S, return_when=FIRST_COMPLETED)
                        for future in ended:
                            del running[future]
                            future.result()
                    elif left and not begun:
                        time.sleep(LOOK_S)
            finally:
                for future in running:
                    future.cancel()
        advance(len(pieces))
        return content

    def _begin(self, left: Sequence[str], folder: str, threads: int, begin: Callable[[str], None], running: dict[Future[None], str]
               ) -> list[str]:
        """Begin pieces that nobody makes while threads are free; return those that are neither done nor begun by this worker."""
        others: list[str] = []
        for place, piece in enumerate(left):
            if len(running) >= threads:
                return [*others, *left[place:]]
            if self._store.read(f"{folder}/{piece}{DONE}") is not None:
                continue
            if self._store.claim(f"{folder}/{piece}{CLAIM}"):
                begin(piece)
            else:
                others.append(piece)
        return others

    def _made(self, name: str, piece: str, make: Callable[[str], bytes]) -> bytes:
        content = make(piece)
        self._store.write(name, sealed(content))
        return content
