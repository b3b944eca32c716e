"""Pieces of an image dealt to several devices, a thread for each.

A device gets the next piece when it is done with one. How the image is cut does not depend on the number of devices, every piece has
pixels of its own, and no piece reads what another found: so results are the same to the last bit on one device and on several of its kind.
"""

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from typing import TypeVar

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
