"""Arrays as bytes, and the surfaces of bricks as such."""

import io
from collections.abc import Mapping
from typing import Any

import numpy as np

from service.scans.surface import VERTEX, BrickSurface

TALLIES = "tallies"


def packed(arrays: Mapping[str, Any]) -> bytes:
    """Return arrays and numbers by their names as bytes."""
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **arrays)
    return buffer.getvalue()


def unpacked(content: bytes) -> dict[str, np.ndarray]:
    """Return the arrays of `packed`."""
    with np.load(io.BytesIO(content), allow_pickle=False) as found:
        return {name: found[name] for name in found.files}


def packed_brick(surface: BrickSurface) -> bytes:
    """Return the surface of a brick as bytes."""
    arrays = {name: getattr(surface, name) for name in (*VERTEX, "edge", "faces", "blocks")}
    numbers = np.array(list(surface.tallies), dtype=np.int64)
    return packed(arrays | {"scans": numbers, TALLIES: np.array(list(surface.tallies.values()), dtype=np.float64)})


def unpacked_brick(content: bytes) -> BrickSurface:
    """Return the surface of `packed_brick`."""
    found = unpacked(content)
    tallies = dict(zip(map(int, found.pop("scans")), found.pop(TALLIES), strict=True))
    blocks = int(found.pop("blocks"))
    return BrickSurface(**found, tallies=tallies, blocks=blocks)
