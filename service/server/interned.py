"""CPython's table of interned strings, of the API process.

pathlib interns each part of a path. The names of uploads are forgotten with their paths, but each has taken a place in the table, which is
made anew, and twice as large, when no place is left: after the names of some thousands of files.
"""

import sys

NAMES, TABLE_BYTES = 43_700, 3_845_000
"""Strings for which a table of 2^17 has no place left beside the 55 000 of the program, and the bytes of a table of 2^18: as many indices
of 4 bytes, and 2/3 as many entries of 16 (https://github.com/python/cpython/blob/3.11/Objects/dictobject.c). A table that has 2^18
already, as with 88 000 to 131 000 strings of the program, has a place for them."""


def enlarge_interned() -> None:
    """Let CPython double the table now, and not in the fourth minute of a load. For the end of a start.

    The new table lies where memory has been written to before, so that names to come make no further pages of it resident.
    """
    written = b"\1" * TABLE_BYTES
    del written
    for number in range(NAMES):
        sys.intern(f"relit {number}")
