"""Whether what was handed in can be worked on: names, headers and sizes, before a pixel is decoded."""

from pathlib import Path
from typing import Any

import numpy as np

from service.pipelines.relighting.sequence import time_steps
from service.progress import Progress, Timings
from stage import images
from stage.capture import Capture
from stage.errors import ImageError, ManifestError, storage
from stage.manifest import FILE_NAME, Manifest, read_manifest


def admit_capture(folder: Path, *, max_pixels: int, progress: Progress | None = None) -> dict[str, Any]:
    """Look at the manifest of a capture, or of a sequence of captures, and the header of every file that it names.

    Args:
        folder: of the capture.
        max_pixels: of an image.
        progress: told of every capture.

    Returns:
        What it is: captures, frames, resolution, colour space.

    Raises:
        ManifestError: the manifest is wrong, or a file lies outside the folder; names the field.
        ImageError: a file is no image, is cut short, or has more pixels than are allowed; names the file.
        StorageError: a file cannot be read.
    """
    timings = Timings(progress)
    steps = time_steps(folder)
    timings.stage("check", len(steps))
    frames, manifest = 0, None
    for done, step in enumerate(steps, start=1):
        if (step / FILE_NAME).is_file():  # else opening it says what is missing
            manifest = read_manifest(step / FILE_NAME)
            width, height = manifest.camera.resolution
            if width * height > max_pixels:
                raise ImageError(f"{step / FILE_NAME}: camera.resolution: {width}x{height} is more than {max_pixels} pixels")
            _check_places(step, manifest, max_pixels)
        manifest = Capture.open(step).manifest
        frames += len(manifest.frames)
        timings.advance(done)
    timings.close()
    assert manifest is not None, "time_steps gives one at the least"
    return {"captures": len(steps), "frames": frames, "resolution": list(manifest.camera.resolution), "color_space": manifest.color_space,
            "name": manifest.name}


def admit_environment(folder: Path, *, max_pixels: int) -> dict[str, Any]:
    """Look at the header of an environment.

    Args:
        folder: which holds one image.
        max_pixels: that it may have.

    Returns:
        What it is: its file and resolution.

    Raises:
        ImageError: not one image, or one of too many pixels.
        StorageError: it cannot be read.
    """
    path = environment_file(folder)
    header = images.read_header(path)
    if header.width * header.height > max_pixels:
        raise ImageError(f"{path.name}: {header.width}x{header.height} is more than {max_pixels} pixels")
    if header.width != 2 * header.height:
        raise ImageError(f"{path.name}: is {header.width}x{header.height}: a lat-long map is twice as wide as it is high")
    return {"file": path.name, "resolution": [header.width, header.height]}


def environment_file(folder: Path) -> Path:
    """The one image of an environment.

    Args:
        folder: which holds it; or the file itself, of one that was registered.

    Raises:
        ImageError: there is none, or there are several.
    """
    if folder.is_file():
        return folder
    with storage("read", folder):
        found = [path for path in sorted(folder.iterdir()) if not path.name.startswith(".")] if folder.is_dir() else []
    if len(found) != 1:
        raise ImageError(f"the environment has {len(found)} files: it is one lat-long image")
    return found[0]


def _check_places(folder: Path, manifest: Manifest, max_pixels: int) -> None:
    """Every file lies in the folder, links followed, and is not too large."""
    inside = folder.resolve()
    capture = Capture(folder, manifest)
    for field, name in capture.files():
        path = capture.file(name)
        if not path.resolve().is_relative_to(inside):
            raise ManifestError(f"{folder / FILE_NAME}: {field}: {name} leads out of the capture's folder")
        if not path.is_file():
            continue  # opening the capture says so
        if path.suffix.lower() == ".npy":
            pixels = _array_pixels(path)
        else:
            header = images.read_header(path)
            pixels = header.width * header.height
        if pixels > max_pixels:
            raise ImageError(f"{path}: has {pixels} pixels, {max_pixels} are allowed")


def _array_pixels(path: Path) -> int:
    try:
        shape = np.load(path, mmap_mode="r", allow_pickle=False).shape
    except (ValueError, OSError, EOFError) as error:
        raise ImageError(f"{path}: is not a NumPy array: {error}") from error
    return int(np.prod(shape[:2], dtype=np.int64))
