"""Names of prims: ASCII identifiers that keep the words of a free text.

Source: OpenUSD, SdfPath: an identifier is a letter or _, then letters, digits and _. OpenUSD takes more letters than those of ASCII;
other readers of its files do not, so that words in other scripts are transliterated (anyascii).
"""

import re
from collections.abc import Container

from anyascii import anyascii

NAMELESS = "Asset"
"""Name of a prim whose text holds no letter and no digit."""


def prim_name(text: str, taken: Container[str] = ()) -> str:
    """Return a valid prim name that keeps the words of a text.

    Args:
        text: in any script; what is no letter and no digit separates words, which are joined by _.
        taken: names of the siblings; a number is added where the name is one of them.
    """
    words = re.findall(r"[A-Za-z0-9_]+", anyascii(text))
    name = "_".join(words).strip("_") or NAMELESS
    if name[0].isdigit():
        name = f"_{name}"
    unique, number = name, 2
    while unique in taken:
        unique, number = f"{name}_{number}", number + 1
    return unique
