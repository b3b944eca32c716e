"""The surfaces of bricks as bytes."""

import numpy as np

from service.scans.surface import VERTEX, BrickSurface
from stage.packed_arrays import packed, unpacked

TALLIES = "tallies"


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
