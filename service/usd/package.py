"""A USDZ package: a zip file with the layer first, nothing compressed, and every file aligned to 64 bytes.

Python's zip writer, because that of USD reports success when the disk is full.
"""

import shutil
import struct
import zipfile
from collections.abc import Sequence
from pathlib import Path

from service.usd.errors import AssetError

ALIGNMENT = 64
"""Bytes, so that readers can map the data of a file from memory (USDZ File Format Specification, "Layout")."""

_LOCAL_HEADER_SIZE = 30
_FIELD_HEADER = struct.Struct("<HH")
_PADDING_FIELD = 0x1986
"""Identifier of the extra field that holds the padding: any that no other program uses; USD's own writer takes this."""


def pack(package: Path, layer: Path, files: Sequence[Path]) -> None:
    """Write a package of a layer and the files that it refers to.

    Args:
        package: its folder holds the layer and, at any depth, the files; their paths relative to it are kept.

    Raises:
        AssetError: more than the 4 GiB that a package can hold.
        OSError: it cannot be written.
    """
    try:
        with open(package, "wb") as stream, zipfile.ZipFile(stream, "w", allowZip64=False) as archive:
            for file in (layer, *files):
                entry = zipfile.ZipInfo(file.relative_to(package.parent).as_posix())  # dated 1980: the same every time
                entry.file_size = file.stat().st_size
                data_starts = stream.tell() + _LOCAL_HEADER_SIZE + len(entry.filename.encode()) + _FIELD_HEADER.size
                padding = -data_starts % ALIGNMENT
                entry.extra = _FIELD_HEADER.pack(_PADDING_FIELD, padding) + bytes(padding)
                with open(file, "rb") as source, archive.open(entry, "w") as member:
                    shutil.copyfileobj(source, member)
    except zipfile.LargeZipFile as error:
        raise AssetError("the asset is larger than the 4 GiB that a .usdz can hold: export a .usdc") from error
