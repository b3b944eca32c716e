"""Limits on names: no control characters (NUL among them), no halves of characters, and a largest length.

A NUL ends a path in the system's calls and cannot be stored by PostgreSQL, half a character cannot be written as UTF-8, and control
characters change what a terminal or a log shows.
"""

import re

REFUSED = re.compile("[\x00-\x1f\x7f-\x9f\ud800-\udfff]")
"""The characters of the Unicode categories Cc (control) and Cs (surrogate)."""

MAX_CHARACTERS = 1000
"""The most characters of a name: file systems take 255 bytes between two slashes, and lists of captures repeat their names."""


def name_fault(text: str) -> str | None:
    """Return why a text cannot be a name, as in `has a control character (U+0000): leave it out`; None if it can."""
    if len(text) > MAX_CHARACTERS:
        return f"has {len(text)} characters: give {MAX_CHARACTERS} or fewer"
    found = REFUSED.search(text)
    if found is None:
        return None
    code = ord(found[0])
    return f"has {'a control character' if code < 0xD800 else 'half a character'} (U+{code:04X}): leave it out"
