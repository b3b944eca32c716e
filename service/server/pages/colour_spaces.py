"""The scene-linear colour spaces that pages know, with the numbers that the jobs convert with."""

import json
from functools import cache
from typing import get_args

from stage import exr
from stage.colour import rgb_matrix
from stage.colour_spaces import ColorSpaceName, is_linear

DISPLAY_SPACE = "lin_rec709_scene"
"""The space of the screen and of three.js."""


@cache
def colour_spaces() -> str:
    """Return JSON with the matrix [9] of each space to linear Rec.709, row by row, and the chromaticities [8] of EXR files that declare it.

    The chromaticities are those of red, green, blue and white, x before y; null: files declare the space by its name alone.
    """
    spaces = {}
    for space in filter(is_linear, get_args(ColorSpaceName)):
        chromaticities = exr.chromaticities(space) if space in exr.PRIMARIES else None
        spaces[space] = {"to_rec709": [float(value) for value in rgb_matrix(space, DISPLAY_SPACE).ravel()],
                         "chromaticities": None if chromaticities is None else [float(value) for value in chromaticities]}
    return json.dumps({"spaces": spaces, "tolerance": exr.PRIMARIES_TOLERANCE})
