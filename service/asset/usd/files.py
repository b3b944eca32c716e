"""USD files on disk: written in a temporary folder beside the target, packed as USDZ where asked, and put in place whole.

Source: the USDZ File Format Specification: a zip file with the layer first, nothing compressed, and every file aligned to 64 bytes. It is
written with Python's zip writer, because that of USD reports success when the disk is full.
"""

import os
import shutil
import struct
import zipfile
from collections.abc import Callable, Container, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from pxr import Tf, Usd

from service.errors import AssetError
from service.requests.export import TextureFormat
from stage.errors import StorageError
from stage.files import folder_beside

SUFFIXES = (".usda", ".usdc", ".usdz")
ALIGNMENT = 64
"""Bytes, so that readers can map the data of a file from memory (USDZ File Format Specification, "Layout")."""

_LOCAL_HEADER_SIZE = 30
_FIELD_HEADER = struct.Struct("<HH")
_PADDING_FIELD = 0x1986
"""Identifier of the extra field that holds the padding: any that no other program uses; USD's own writer takes this."""


def check_suffix(target: Path) -> str:
    """Return the suffix of an asset in lower case; it must be that of a USD file."""
    suffix = target.suffix.lower()
    if suffix not in SUFFIXES:
        raise AssetError(f"{target} cannot be written as a USD asset: its suffix must be .usda, .usdc or .usdz")
    return suffix


def check_textures(target: Path, textures: TextureFormat) -> str:
    """Return the suffix of an asset in lower case, if such a file can hold these textures."""
    suffix = check_suffix(target)
    if suffix == ".usdz" and textures is TextureFormat.EXR:
        raise AssetError(f"{target} cannot hold EXR textures, which ARKit and three.js do not read in a .usdz: export a .usda or .usdc, or "
                         "store the textures as png16")
    return suffix


def write_layer(target: Path, define: Callable[[Usd.Stage], None]) -> None:
    """Write a USD file that refers to no other file, whole or not at all; `define` fills the empty stage."""
    suffix = check_suffix(target)
    with temporary_folder_beside(target) as temporary:
        layer = temporary / f"{target.stem}{'.usdc' if suffix == '.usdz' else suffix}"
        usd_stage = Usd.Stage.CreateNew(str(layer))
        define(usd_stage)
        usd_stage.Save()
        del usd_stage
        install(target, layer, (), ours=())


def install(target: Path, layer: Path, files: Sequence[Path], *, ours: Container[str], apart: Sequence[Path] = ()) -> None:
    """Flush an asset to the disk and put it in place of an older one, whole or not at all; as a package where the target is a .usdz.
    Raises AssetError if it is larger than a package can be. Raises StorageError if there is something else in place of a folder. Raises
    OSError if the disk refuses; what was there before is put back.

    Args:
        layer: the asset's first layer, in the folder of temporary_folder_beside.
        files: that it refers to, in folders of that folder. Unless they are packed, these folders take the place of older ones beside the
            target.
        ours: names of files that an older asset can have in such a folder; other files that lie there stay.
        apart: files in folders of their own that are never packed. Beside a package, which does not refer to them, older ones stay too.
    """
    folders = [folder for folder in sorted(layer.parent.iterdir()) if folder.is_dir()]
    if check_suffix(target) == ".usdz":
        package = layer.with_suffix(".usdz")
        _pack(package, layer, files)
        layer, files, ours = package, (), ()
        folders = sorted({file.parent for file in apart})
    files = [*files, *apart]
    for file in (layer, *files):
        with open(file, "rb") as written:
            os.fsync(written.fileno())
    folders = folders if files else []
    for folder in folders:
        place = target.parent / folder.name
        if place.is_symlink() or (place.exists() and not place.is_dir()):
            raise StorageError(f"cannot write {target}: {place} is no folder, and the asset needs a folder of this name: move it away")
    renamed: list[tuple[Path, Path]] = []

    def rename(source: Path, destination: Path) -> None:
        os.rename(source, destination)
        renamed.append((source, destination))

    try:
        for folder in folders:
            place, replaced = target.parent / folder.name, folder.with_name(f"{folder.name}.replaced")
            if place.exists():
                rename(place, replaced)
            rename(folder, place)
            for file in replaced.iterdir() if replaced.exists() else ():
                if file.name not in ours and not (place / file.name).exists():
                    rename(file, place / file.name)
        os.replace(layer, target)
    except BaseException:  # whoever interrupts the program, too, finds what was there before
        for source, destination in reversed(renamed):
            os.rename(destination, source)
        raise
    for folder in folders:
        if not any((target.parent / folder.name).iterdir()):
            (target.parent / folder.name).rmdir()


@contextmanager
def temporary_folder_beside(target: Path) -> Iterator[Path]:
    """Yield a temporary folder beside the target, removed at the end; errors of disk and USD become StorageErrors about the target."""
    try:
        with folder_beside(target) as temporary:
            yield temporary
    except Tf.ErrorException as error:
        raise StorageError(f"cannot write {target}: {reason_of(error)}") from error


def _pack(package: Path, layer: Path, files: Sequence[Path]) -> None:
    """Write a package of a layer and the files that it refers to, in the folder of both, relative to which their paths are kept."""
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


def reason_of(error: Tf.ErrorException) -> str:
    """Return the first reason that USD gives, without the place in its source."""
    reasons = [str(getattr(cause, "commentary", cause)).strip() for cause in error.args]
    return reasons[0].splitlines()[0].lower() if reasons and reasons[0] else "USD could not write it"
