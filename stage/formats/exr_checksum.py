"""A checksum in the header of an EXR file, of all its bytes, which tells a damaged file from the file that was written.

The chunk tables of an EXR tell a truncated file, and the decoder some of the flipped bytes; the checksum tells any other file apart. It
is computed with its own digits as zeros, so that it can lie in the file.
"""

import hashlib
import struct
from pathlib import Path

from stage import inputs
from stage.errors import StorageError, storage

ATTRIBUTE = "relit:checksum"
"""The attribute of the first part that holds the checksum: BLAKE2b with 16 bytes, in hexadecimal digits."""
DIGITS = 32
UNSET = "0" * DIGITS
"""The value of the attribute while the file is written, and for which the checksum is computed."""
HEADER_BYTES = 4 << 20
"""The bytes from the start of a file in which the attribute is looked for: the headers of a frame take a few kilobytes."""
BLOCK = 1 << 20
"""The bytes of a file that are read at one time."""
_LEAD = ATTRIBUTE.encode() + b"\0string\0" + struct.pack("<i", DIGITS)
"""The bytes before the digits: name, type and length of the attribute."""


def write_checksum(path: Path) -> None:
    """Put the checksum of a file into its attribute, which was written as UNSET."""
    place, checksum = _place_and_checksum(path)
    if place is None:
        raise StorageError(f"cannot write {path}: its header has no {ATTRIBUTE}")
    with storage("write", path), open(path, "r+b") as file:
        file.seek(place)
        file.write(checksum.encode())


def is_intact(path: Path) -> bool:
    """Return whether every byte of a file is as it was written; False where the file has no checksum."""
    place, checksum = _place_and_checksum(path)
    if place is None:
        return False
    with inputs.opened(path) as source, storage("read", path):
        source.file.seek(place)
        return bool(source.file.read(DIGITS) == checksum.encode())


def _place_and_checksum(path: Path) -> tuple[int | None, str]:
    """Return where the digits of the checksum begin, None if there are none, and the checksum that the file should have."""
    content = hashlib.blake2b(digest_size=DIGITS // 2)
    with inputs.opened(path) as source, storage("read", path):
        start = source.file.read(HEADER_BYTES)
        found = start.find(_LEAD)
        place = found + len(_LEAD)
        if found < 0 or place + DIGITS > len(start):
            return None, ""
        content.update(start[:place] + UNSET.encode() + start[place + DIGITS :])
        while block := source.file.read(BLOCK):
            content.update(block)
    return place, content.hexdigest()
