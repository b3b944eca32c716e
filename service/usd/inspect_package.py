"""Whether a .usdz package is sound, and whether ARKit takes it.

Source: the USDZ File Format Specification (layout, file types); Apple, "Creating USD files for Apple devices": the root layer is binary and
refers to no other layer.
"""

import zipfile
from pathlib import Path, PurePosixPath

from pxr import Sdf

from service.asset.errors import AssetError
from service.usd.files import ALIGNMENT
from stage.errors import storage

LAYERS = (".usd", ".usda", ".usdc")
IMAGES = (".png", ".jpg", ".jpeg", ".exr", ".avif")
SOUNDS = (".m4a", ".mp3", ".wav")
BINARY = b"PXR-USDC"
"""The first bytes of a binary layer."""

_LOCAL_HEADER_SIZE = 30
_LENGTHS_AT = 26
"""Where the lengths of name and extra field stand in the header of an entry: two numbers of two bytes."""


def package_findings(path: Path) -> list[str]:
    """Return what is wrong with a package, sentence by sentence.

    Raises:
        AssetError: it is no package, or a damaged one.
        StorageError: it cannot be read.
    """
    with storage("read", path):
        try:
            with zipfile.ZipFile(path) as archive:
                damaged = archive.testzip()
                entries = archive.infolist()
            offsets = [_data_offset(path, entry) for entry in entries]
        except (zipfile.BadZipFile, NotImplementedError, EOFError) as error:
            raise AssetError(f"{path} is no USDZ package, or only a part of one: {str(error).lower()}") from error
    if damaged is not None:
        raise AssetError(f"{path} is damaged: the checksum of {damaged} does not fit")
    if not entries or PurePosixPath(entries[0].filename).suffix.lower() not in LAYERS:
        raise AssetError(f"{path} is no USDZ package: its first file is no USD layer")
    found = []
    for entry, offset in zip(entries, offsets, strict=True):
        suffix = PurePosixPath(entry.filename).suffix.lower()
        if entry.compress_type != zipfile.ZIP_STORED:
            raise AssetError(f"{path} is no USDZ package: {entry.filename} is compressed in it")
        if offset % ALIGNMENT:
            found.append(f"{entry.filename} is not aligned to {ALIGNMENT} bytes in the package")
        if suffix not in (*LAYERS, *IMAGES, *SOUNDS):
            found.append(f"{entry.filename}: USDZ knows no files of this type")
    return found


def arkit_findings(path: Path, root_layer: Sdf.Layer) -> list[str]:
    """Return why ARKit does not take a package that is sound otherwise."""
    found = []
    with zipfile.ZipFile(path) as archive, archive.open(archive.infolist()[0]) as first:
        binary = first.read(len(BINARY)) == BINARY
    if not binary:
        found.append("ARKit takes a binary root layer, and that of this package is text")
    others = sorted(root_layer.GetCompositionAssetDependencies())
    if others:
        found.append(f"ARKit takes packages of one layer, and the root layer of this one refers to {', '.join(others)}")
    return found


def _data_offset(path: Path, entry: zipfile.ZipInfo) -> int:
    """Return where the data of an entry begin, in bytes."""
    with open(path, "rb") as stream:
        stream.seek(entry.header_offset + _LENGTHS_AT)
        lengths = stream.read(4)
    return entry.header_offset + _LOCAL_HEADER_SIZE + int.from_bytes(lengths[:2], "little") + int.from_bytes(lengths[2:], "little")
