"""A USD asset on disk: solved maps → .usda, .usdc or .usdz. It appears whole or not at all."""

import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from pxr import Tf, Usd

from service.usd.errors import AssetError
from service.usd.mesh import height_mesh
from service.usd.package import pack
from service.usd.scene import define_asset
from service.usd.textures import FILE_NAMES, write_textures
from stage.errors import StorageError, storage
from stage.maps import SurfaceMaps

SUFFIXES = (".usda", ".usdc", ".usdz")

Progress = Callable[[str, float], None]
"""Is told what is being done now, and which part of the whole was done before it (0…1)."""

TEXTURES_START, TEXTURES_END = 0.1, 0.9
"""Where the textures lie in the whole, as measured for 4000 by 3000 pixels."""


class AssetReport(NamedTuple):
    """What was written."""

    path: Path  # the asset
    textures: tuple[Path, ...]  # files beside it; empty for .usdz, which holds them
    vertex_count: int
    face_count: int
    step: int  # every step-th pixel in both directions carries a vertex
    clipped_pixels: dict[str, int]  # layer → pixels that did not fit into 0…1


def write_asset(maps: SurfaceMaps, path: str | Path, *, name: str, progress: Progress | None = None) -> AssetReport:
    """Write solved maps as a USD asset.

    Args:
        maps: with `height`.
        path: its suffix chooses the format. Textures of .usda and .usdc go to the folder `<stem>_textures` beside it;
            a .usda and a .usdc of one name share that folder.
        name: free text; the root prim is named after it.
        progress: called before each part of the work.

    Raises:
        AssetError: another suffix; no height layer, or no face; a colour space that is not known.
        StorageError: the disk refuses; what was there before is left as it was.
    """
    target = Path(path)
    suffix = known_suffix(target)
    tell = progress or (lambda what, done: None)

    tell("mesh", 0.0)
    mesh = height_mesh(maps)
    with workshop_beside(target) as workshop:
        folder = workshop / f"{target.stem}_textures"
        folder.mkdir()
        textures = write_textures(maps, mesh, folder, progress=lambda layer, done: tell(
            f"texture {layer}", TEXTURES_START + (TEXTURES_END - TEXTURES_START) * done))
        tell("layer", TEXTURES_END)
        layer = workshop / f"{target.stem}{'.usdc' if suffix == '.usdz' else suffix}"
        usd_stage = Usd.Stage.CreateNew(str(layer))
        define_asset(usd_stage, maps, mesh, textures, name=name, texture_folder=f"./{folder.name}")
        usd_stage.Save()
        del usd_stage
        files = [folder / texture.file_name for texture in textures.values()]
        if suffix == ".usdz":
            tell("package", 0.95)
            package = workshop / f"{target.stem}.usdz"
            pack(package, layer, files)
            flush(package)
            os.replace(package, target)
            files = []
        else:
            flush(layer, *files)
            _install(layer, folder, target)
    installed = tuple(target.parent / file.relative_to(workshop) for file in files)
    return AssetReport(target, installed, len(mesh.points), len(mesh.face_counts), mesh.step,
                       {layer: texture.clipped_pixels for layer, texture in textures.items()})


def known_suffix(target: Path) -> str:
    """The suffix of an asset, in lower case.

    Raises:
        AssetError: it is none that can be written.
    """
    suffix = target.suffix.lower()
    if suffix not in SUFFIXES:
        raise AssetError(f"{target} cannot be written as a USD asset: its suffix must be .usda, .usdc or .usdz")
    return suffix


@contextmanager
def workshop_beside(target: Path) -> Iterator[Path]:
    """A temporary folder beside the target, gone at the end; errors inside become StorageErrors about the target."""
    with storage("write", target):
        target.parent.mkdir(parents=True, exist_ok=True)
        workshop = Path(tempfile.mkdtemp(prefix=f".{target.stem}.", dir=target.parent))
    try:
        with storage("write", target):
            yield workshop
    except Tf.ErrorException as error:
        raise StorageError(f"cannot write {target}: {_reason(error)}") from error
    finally:
        shutil.rmtree(workshop, ignore_errors=True)


def _install(layer: Path, folder: Path, target: Path) -> None:
    """Put the textures, then the layer, in place of older ones; on an error the older ones come back."""
    place, replaced = target.parent / folder.name, folder.with_name("replaced")
    if place.exists():
        os.rename(place, replaced)
    try:
        os.rename(folder, place)
        os.replace(layer, target)
    except OSError:
        if place.exists():
            os.rename(place, folder)
        if replaced.exists():
            os.rename(replaced, place)
        raise
    if replaced.exists():  # files that are not ours stay
        for file in replaced.iterdir():
            if file.name not in FILE_NAMES:
                os.rename(file, place / file.name)


def flush(*files: Path) -> None:
    """See files onto the disk, before they get their names."""
    for file in files:
        with open(file, "rb") as written:
            os.fsync(written.fileno())


def _reason(error: Tf.ErrorException) -> str:
    """The first reason that USD gives, without the place in its source."""
    reasons = [str(getattr(cause, "commentary", cause)).strip() for cause in error.args]
    return reasons[0].splitlines()[0].lower() if reasons and reasons[0] else "USD could not write it"
