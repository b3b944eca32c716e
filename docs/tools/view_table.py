"""The table of the view transform ACES 2.0 that pages show light through: `make colour-table` writes it, and a test compares it."""

import sys

import numpy as np

from stage.colour.colour import through_view
from stage.colour.colour_spaces import Review

SIDE, FIRST, STOPS = 33, -12.0, 19.0
"""Values of red, green and blue, evenly spaced in stops of linear Rec.709 from the first; view_transforms.js has the same numbers."""


def view_table() -> bytes:
    """Return display values [blue, green, red, 3] as bytes; the first value of each channel stands for all below it, and for black."""
    values = 2.0 ** np.linspace(FIRST, FIRST + STOPS, SIDE)
    values[0] = 0
    blue, green, red = np.meshgrid(values, values, values, indexing="ij")
    pixels = np.stack([red, green, blue], axis=-1).reshape(SIDE * SIDE, SIDE, 3).astype(np.float32)
    return np.rint(255 * through_view(pixels, "lin_rec709_scene", Review(None, None))).astype(np.uint8).tobytes()


if __name__ == "__main__":
    sys.stdout.buffer.write(view_table())
