"""The colour spaces that pages convert between, as the module that they load: `make colour-table` writes it, and a test compares it."""

import json

from stage.colour.colour import rgb_matrix
from stage.colour.colour_spaces import NAMES, is_linear, linear_space
from stage.formats import exr

DIGITS = 6
"""Decimals of the numbers: those that float32 surely has."""


def colour_table() -> str:
    """Return a JavaScript module with the matrix [9] of each scene-linear space to linear Rec.709, row by row, and its chromaticities [8].

    The chromaticities are those by which EXR files declare the space: red, green, blue and white, x before y; null: files declare it by
    its name alone. Values of `oiio:ColorSpace` by which they declare one, and those of `colorInteropID` that name none, follow.
    """
    spaces = {}
    for space in filter(is_linear, NAMES):
        chromaticities = exr.chromaticities(space) if space in exr.PRIMARIES else None
        spaces[space] = {"toRec709": [round(float(value), DIGITS) for value in rgb_matrix(space, linear_space("srgb_texture")).ravel()],
                         "chromaticities": None if chromaticities is None else [round(float(value), DIGITS) for value in chromaticities]}
    lines = ",\n".join(f"  {name}: {json.dumps(numbers)}" for name, numbers in spaces.items())
    return ("/** Colour spaces by name, how far declared chromaticities may differ, and other names: written by `make colour-table`. */\n"
            f"export const spaces = {{\n{lines},\n}};\nexport const tolerance = {exr.PRIMARIES_TOLERANCE};\n"
            f"export const writtenByOiio = {json.dumps(exr.WRITTEN_BY_OIIO)};\nexport const undeclared = {json.dumps(exr.UNDECLARED)};\n")


if __name__ == "__main__":
    print(colour_table(), end="")
