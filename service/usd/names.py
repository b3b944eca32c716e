"""Names of prims: ASCII identifiers that keep the words of a free text.

Source: OpenUSD, SdfPath: an identifier is a letter or _, then letters, digits and _. OpenUSD takes more letters than those of ASCII;
other readers of its files do not, so that words in other scripts are transliterated (anyascii).
"""

import re

from anyascii import anyascii

NAMELESS = "Asset"
"""Name of a prim whose text holds no letter and no digit."""


def prim_name(text: str) -> str:
    """Return a valid prim name that keeps the words of a text, which may be in any script.

    Whatever is no letter and no digit separates words, which are joined by _. Only the root prim of an asset is named after a text, so that
    the name needs to differ from no other.
    """
    words = re.findall(r"[A-Za-z0-9_]+", anyascii(text))
    name = "_".join(words).strip("_") or NAMELESS
    return f"_{name}" if name[0].isdigit() else name
