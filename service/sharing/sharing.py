"""A solve that several workers share: each runs the same solve, and every piece of a pass over the image is done by one of them.

What a pass finds at the pixels of a piece is stored under the number of the pass and the number of the piece, from where the other workers
read it. So all have the same arrays when a pass ends, and the next begins. What looks at the whole object is done by every worker: kernels
add nothing up in the order in which threads happen to end, so workers on devices of one kind find the same. A digest of what a pass follows
from is part of its name; a worker that finds something else shares nothing any more.

A device gets the next piece when it is done with one. How the image is cut does not depend on the number of devices, every piece has
pixels of its own, and no piece reads what another found: so results are the same to the last bit on one device and on several of its kind.
"""

import dataclasses
import hashlib
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from typing import Any, NamedTuple, Protocol, TypeVar

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.device import to_numpy
from service.errors import DivergedError
from service.reporting.provenance import versions
from stage.formats.npy import packed, unpacked

# Storage in which the workers of one job keep their pieces, and the check that they work at the same job.
LOOK_S = 0.2
"""Seconds between two looks for the pieces that others do."""
DIGEST_BYTES = 32
"""Length of the SHA-256 before the content of a piece."""


class PieceStore(Protocol):
    """Storage of the pieces that the workers of a job find. The methods are called by several threads."""

    def read(self, name: str) -> bytes | None:
        """Return what was stored under a name, or None."""

    def write(self, name: str, content: bytes) -> None:
        """Store something under a name, whole or not at all."""

    def claim(self, name: str) -> bool:
        """Return whether this worker is to do a piece: False while another, which is still at work, has claimed it."""


def agree(store: PieceStore, name: str, follows_from: str, *, leads: bool, is_begun: bool) -> None:
    """Record what a pass over the pieces follows from, or compare it with what the worker that leads has recorded.

    Args:
        name: of the pass.
        follows_from: a digest of all that the pass follows from.
        leads: whether this worker has the job.
        is_begun: whether the worker that leads has begun this pass, if it works at the same.

    Raises:
        DivergedError: this worker does not lead, and has something else.
    """
    found = store.read(name)
    if leads and found != follows_from.encode():
        store.write(name, follows_from.encode())
    elif not leads and found != follows_from.encode() and (is_begun or found is not None):
        raise DivergedError("inputs, versions, device or findings are not those of the worker that has the job")


def sealed(content: bytes) -> bytes:
    """Return content with its SHA-256 before it."""
    return hashlib.sha256(content).digest() + content


def opened(stored: bytes | None) -> bytes | None:
    """Return the content that `sealed` got, or None if it is not there or not what was written."""
    if stored is None or hashlib.sha256(stored[DIGEST_BYTES:]).digest() != stored[:DIGEST_BYTES]:
        return None
    return stored[DIGEST_BYTES:]


Piece = TypeVar("Piece")


def deal(devices: Sequence[str], pieces: Iterable[Piece], work: Callable[[Piece, str], None], done: Callable[[Piece], None]) -> None:
    """Do the work of every piece.

    Args:
        devices: names of one or more; one that is named twice works on two pieces at a time.
        pieces: are taken one by one in the thread of the caller.
        work: does a piece on a device, and stores what it finds at the piece's own pixels; called in several threads at once.
        done: is told each piece when it is done, on several devices not in their order; called in the thread of the caller.

    Raises:
        BaseException: what a piece or `done` raised, or an interruption; no piece is begun after it, and those of all devices have ended.
    """
    left = iter(pieces)
    if len(devices) == 1:
        for piece in left:
            work(piece, devices[0])
            done(piece)
        return
    with ThreadPoolExecutor(len(devices), thread_name_prefix="relit-device") as pool:
        running: dict[Future[None], tuple[Piece, str]] = {}

        def begin(device: str) -> None:
            for piece in left:
                running[pool.submit(work, piece, device)] = piece, device
                return

        for device in devices:
            begin(device)
        while running:
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                piece, device = running.pop(future)
                future.result()
                begin(device)
                done(piece)


LEAST_PIECES = 2
"""A pass of fewer pieces is done by every worker."""


class Results(NamedTuple):
    """The results of a pass over the image, and the values that they follow from."""

    arrays: Sequence[np.ndarray]  # each [..., pixels]: where the work of a piece stores what it finds, at the pixels of the piece
    follows_from: object = None
    """Values that the work reads besides the images and the results of earlier passes: numbers, strings, arrays, and tuples of these."""


class SharedSolve:
    """The part of one worker in a solve."""

    def __init__(self, store: PieceStore, *, leads: bool, invite: Callable[[int], None] = lambda pieces: None) -> None:
        """Take part in the solve whose pieces are in the store.
        `leads`: whether this worker has the job; it alone says what a pass follows from. `invite`: called with the number of pieces
        before each pass that can be shared."""
        self._store, self._leads, self._invite = store, leads, invite
        self._solve, self._passes, self._has_agreed = "", 0, False

    def identify(self, device: str, *given: object) -> None:
        """Take note of what is solved: workers with other inputs, programs or kinds of device share nothing."""
        self._solve = digest((kind_of_worker(device), given))

    def deal(self, names: Sequence[str], pieces: Sequence[Piece], work: Callable[[Piece, str], None], done: Callable[[Piece], None], *,
             waiting: Callable[[], None], pixels_of: Callable[[Piece], Any], results: Results) -> None:
        """Do the pieces of a pass that no other worker does, and read those of the others.
        `names, pieces, work, done`: as of `deal`; `done` is told the pieces of other workers too. `waiting`: called now and then while
        pieces of other workers are waited for. `pixels_of`: returns the place of a piece on the last axis of the arrays."""
        self._passes += 1
        if len(pieces) < LEAST_PIECES:
            deal(names, pieces, work, done)
            return
        shared = _Pass(self._store, f"{self._solve[:16]}/{self._passes:03d}", digest(results.follows_from), self._leads, results.arrays)
        shared.agree(is_begun=not self._has_agreed)
        self._has_agreed = True
        self._invite(len(pieces))

        def keep(piece: tuple[int, Piece], device: str) -> None:
            work(piece[1], device)
            shared.write(piece[0], pixels_of(piece[1]))

        def left() -> Iterator[tuple[int, Piece]]:
            open_pieces = list(enumerate(pieces))
            while open_pieces:
                others = []
                for number, piece in open_pieces:
                    if shared.read(number, pixels_of(piece)):
                        done(piece)
                    elif shared.claim(number):
                        yield number, piece
                    else:
                        others.append((number, piece))
                if len(others) == len(open_pieces):
                    waiting()
                    time.sleep(LOOK_S)
                open_pieces = others

        deal(names, left(), keep, lambda piece: done(piece[1]))


class _Pass:
    def __init__(self, store: PieceStore, name: str, follows_from: str, leads: bool, arrays: Sequence[np.ndarray]) -> None:
        self._store, self._name, self._leads, self._arrays = store, name, leads, arrays
        self._follows_from = follows_from
        self._folder = f"{name}-{follows_from[:16]}"

    def agree(self, *, is_begun: bool = False) -> None:
        """Record what the pass follows from, or compare it with what the worker that leads has recorded; as `agree` does."""
        agree(self._store, self._name, self._follows_from, leads=self._leads, is_begun=is_begun)

    def read(self, number: int, pixels: Any) -> bool:
        """Take over what another worker has found in a piece; return False if it is not there."""
        content = opened(self._store.read(self._file(number)))
        found = None if content is None else list(unpacked(content).values())
        places = [array[..., pixels] for array in self._arrays]
        if found is None or [(a.shape, a.dtype) for a in found] != [(a.shape, a.dtype) for a in places]:
            return False
        for array, values in zip(self._arrays, found, strict=True):
            array[..., pixels] = values
        return True

    def claim(self, number: int) -> bool:
        """Return whether this worker is to do a piece."""
        if not self._leads:
            self.agree()
        return self._store.claim(f"{self._file(number)}.claim")

    def write(self, number: int, pixels: Any) -> None:
        """Give the others what this worker has found in a piece."""
        found = {str(place): array[..., pixels] for place, array in enumerate(self._arrays)}
        self._store.write(self._file(number), sealed(packed(found)))

    def _file(self, number: int) -> str:
        return f"{self._folder}/{number:05d}"


def kind_of_worker(device: str) -> str:
    """Return what workers have in common that find the same to the last bit: the kind of device and all versions."""
    return digest((devices.kind(device), versions()))


def digest(value: object) -> str:
    """Return the SHA-256, hexadecimal, of numbers, strings, arrays and of tuples, lists and dataclasses of these.
    Raises TypeError: a value is of another kind, whose content is not known."""
    hasher = hashlib.sha256()
    _add(value, hasher.update)
    return hasher.hexdigest()


def _add(value: object, add: Callable[[bytes], None]) -> None:
    if isinstance(value, wp.array):
        value = to_numpy(value)
    if isinstance(value, np.ndarray):
        add(f"{value.dtype}{value.shape}".encode())
        add(np.ascontiguousarray(value).tobytes())
    elif value is None or isinstance(value, bool | int | float | str | np.generic):
        add(f"{type(value).__name__} {value!r};".encode())
    elif isinstance(value, tuple | list):
        add(f"{type(value).__name__} {len(value)}:".encode())
        for part in value:
            _add(part, add)
    elif isinstance(value, dict):
        _add(list(value.items()), add)
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        _add([(field.name, getattr(value, field.name)) for field in dataclasses.fields(value)], add)
    else:
        raise TypeError(f"the content of a {type(value).__name__} is not known")
