"""Encodings that recorded values could have in place of the declared one: linear, by sRGB, or by a power of 2.2."""

from collections.abc import Iterator

import numpy as np

from stage.colour.colour import convert, linearise
from stage.colour.colour_spaces import is_linear, linear_space

ENCODINGS = {"srgb_texture": "sRGB", "g22_rec709_scene": "a power of 2.2"}
"""Display encodings that images declared linear may have, in words; both have the primaries of Rec.709, which do not matter for the
curve."""
MOST_ENCODED = 1.001
"""The largest value of display-encoded images, but for rounding."""


def other_readings(radiance: np.ndarray, exposure: np.ndarray | float, declared: str) -> Iterator[tuple[str, np.ndarray]]:
    """Yield the radiance that the same recorded values stand for under other encodings, with the colour space that declares each.

    Args:
        radiance: [..., rows, cols, 3], scene-linear as declared; if it is declared linear, other encodings need values up to 1.
        exposure: recorded values over radiance; has the dimensions of `radiance` or fewer.
    """
    recorded = (radiance * exposure).astype(np.float32)
    if not is_linear(declared):
        yield linear_space(declared), convert(recorded, linear_space(declared), declared).astype(np.float64) / exposure
    elif recorded.max(initial=0) <= MOST_ENCODED:
        for space in ENCODINGS:
            yield space, linearise(recorded, space).astype(np.float64) / exposure
