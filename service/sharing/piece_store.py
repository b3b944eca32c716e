"""Storage in which the workers of one job keep their pieces, and the check that they work at the same job."""

import hashlib
from typing import Protocol

from service.errors import DivergedError

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
