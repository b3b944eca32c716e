"""Admission of uploaded captures and environments: places of files, headers and sizes, in little memory and without decoding a pixel."""

from pathlib import Path
from typing import Any

from service.relight.time_steps import time_steps
from service.reporting.progress import Progress, Timings
from stage import inputs
from stage.capture.capture import Capture
from stage.capture.lighting import has_placeholders
from stage.capture.manifest import FILE_NAME, LIT_BY, Manifest, read_manifest
from stage.capture.sequence import SEQUENCE_FILE, is_sequence, read_sequence
from stage.colour.environment_maps import SUFFIXES
from stage.errors import ImageError, ManifestError, storage
from stage.files import resolved
from stage.formats import images, integrity
from stage.formats.npy import array_shape
from stage.records import read_record
from stage.results.depth_maps import DEPTH_FILE
from stage.sets.board import SCAN_FILE as BOARD_FILE
from stage.sets.board import BoardScan
from stage.tof.scan import FILE_NAME as SCAN_FILE
from stage.tof.scan import read_scan

MAX_MANIFEST_BYTES = 16 << 20
"""Largest capture.json: 20 000 frames have a quarter of it. Read, it takes up to 40 times as much memory."""
MAX_CHANNELS = 4
"""Channels of an image that has as many pixels as are allowed; a smaller one may have more, as its channels are decoded together."""


def admit_capture(folder: Path, *, max_pixels: int, progress: Progress | None = None) -> dict[str, Any]:
    """Check the manifest of a capture, or of a sequence of captures, and the header of every file that it names; or the shots of a scan,
    or the tiles of a board. Returns a description: number of captures and frames, resolution, colour space, name, and what frames are lit
    by, as `LIT_BY` names it; of a scan its number of shots and name; of a board its number of tiles and name. Raises ManifestError if the
    manifest is wrong, or a file lies outside the folder; names the field. Raises ImageError if a file is not an image, is cut short, or has
    more pixels than are allowed; names the file. Raises StorageError if a file cannot be read."""
    if (folder / BOARD_FILE).is_file() and not (folder / FILE_NAME).exists():
        return _admit_board(folder, max_pixels)
    if (folder / SCAN_FILE).is_file() and not (folder / FILE_NAME).exists():
        shots = read_scan(folder)
        return {"captures": 0, "frames": 0, "shots": len(shots.time_s), "name": shots.scan.name}
    timings = Timings(progress)
    frames, last, lit_by = 0, None, set[str]()
    _check_manifest_files(folder)
    steps = time_steps(folder)
    timings.stage("check", len(steps))
    for done, step in enumerate(steps, start=1):
        if (step / FILE_NAME).is_file():  # else opening it says what is missing
            _check_places(step, read_manifest(step / FILE_NAME), folder, max_pixels)
        last = Capture.open(step)
        manifest = last.manifest
        frames += len(manifest.frames)
        lit_by |= {name for frame in manifest.frames for name in LIT_BY if getattr(frame, name) is not None}
        timings.advance(done)
    timings.close()
    assert last is not None, "time_steps gives at least one"
    return {"captures": len(steps), "frames": frames, "resolution": list(manifest.camera.resolution), "color_space": manifest.color_space,
            "name": manifest.name, "lit_by": sorted(lit_by), "calibrated": calibrations_of(last),
            **({"steps": len(steps)} if is_sequence(folder) else {})}


def calibrations_of(capture: Capture) -> list[str]:
    """Return what a capture was calibrated with: dark, flat, lights (their directions or positions), colours; in this order."""
    manifest = capture.manifest
    there = {"dark": manifest.dark is not None, "flat": manifest.flat is not None,
             "lights": bool(capture.sources()) and not has_placeholders(capture),
             "colours": manifest.color_matrix is not None or any(frame.color_matrix is not None for frame in manifest.frames)}
    return [name for name, is_there in there.items() if is_there]


def _admit_board(folder: Path, max_pixels: int) -> dict[str, Any]:
    """Check the tiles of a board as `admit_capture` checks captures."""
    _check_place(folder / BOARD_FILE, folder, BOARD_FILE)
    scan = read_record(folder / BOARD_FILE, BoardScan)
    for number, tile in enumerate(scan.tiles):
        place = folder / tile.path
        if (depth := place / DEPTH_FILE).exists() or depth.is_symlink():
            raise ManifestError(f"{folder / BOARD_FILE}: tiles[{number}]: {tile.path} holds a {DEPTH_FILE}: the service takes captures as "
                                "tiles, whose images it decodes in other processes")
        _check_place(place / FILE_NAME, folder, f"{folder / BOARD_FILE}: tiles[{number}]: {tile.path}/{FILE_NAME}")
        _check_manifest_files(place)
        _check_places(place, read_manifest(place / FILE_NAME), folder, max_pixels)
        Capture.open(place)
    return {"captures": 0, "frames": 0, "tiles": len(scan.tiles), "name": scan.name}


def recheck_capture(folder: Path, *, max_pixels: int, number: int | None = None) -> None:
    """Check again what may have changed since a capture was admitted: where its files lie, and their sizes.

    Opening the capture then checks everything else. A file that is changed between the two checks is not noticed. Of a sequence all steps
    are checked, or the only one whose images are read, of a number from 1.
    """
    _check_manifest_files(folder)
    steps = time_steps(folder)
    for step in steps if number is None else steps[number - 1 : number]:
        if (step / FILE_NAME).is_file():
            _check_places(step, read_manifest(step / FILE_NAME), folder, max_pixels)


def admit_environment(folder: Path, *, max_pixels: int) -> dict[str, Any]:
    """Check the header of an environment map, the only image of a folder, and return its file and resolution.
    Raises ImageError if there is not exactly one image, it is not a lat-long map, or it has too many pixels. Raises StorageError if it
    cannot be read."""
    path = environment_file(folder)
    if path.suffix.lower() not in SUFFIXES:
        raise ImageError(f"{path}: an environment is a lat-long .exr or .hdr")
    header = _check_image(path, max_pixels)
    if header.width != 2 * header.height:
        raise ImageError(f"{path}: is {header.width}x{header.height}: a lat-long map is twice as wide as it is high")
    return {"file": path.name, "resolution": [header.width, header.height]}


def environment_file(folder: Path) -> Path:
    """Return the only file of a folder, or the file that was given, as for a registered environment."""
    if folder.is_file():
        return folder
    with storage("read", folder):
        found = [path for path in sorted(folder.iterdir()) if not path.name.startswith(".")] if folder.is_dir() else []
    if len(found) != 1:
        raise ImageError(f"the environment has {len(found)} files: it is one lat-long image")
    return found[0]


def _check_manifest_files(folder: Path) -> None:
    """Check that every manifest lies in the folder and is small enough to be read into memory."""
    with storage("read", folder):
        first = folder / FILE_NAME
        found = [first] if first.exists() or first.is_symlink() or not folder.is_dir() else sorted(folder.glob(f"*/{FILE_NAME}"))
        if found != [first] and ((file := folder / SEQUENCE_FILE).exists() or file.is_symlink()):
            _check_manifest_file(file, folder)
            found = [step.folder / FILE_NAME for step in read_sequence(file).steps]
            for number, path in enumerate(found):  # whether it exists or not: that is nobody's business
                if (place := resolved(path)) is None or not place.is_relative_to(folder.resolve()):
                    raise ManifestError(f"{file}: steps[{number}].path leads out of the capture's folder")
        for path in found:
            if path.exists() or path.is_symlink():  # else opening it says so
                _check_manifest_file(path, folder)


def _check_manifest_file(path: Path, folder: Path) -> None:
    _check_place(path, folder, f"{path}")
    if (size := path.stat().st_size) > MAX_MANIFEST_BYTES:
        raise ManifestError(f"{path}: has {size} bytes, {MAX_MANIFEST_BYTES} are read")


def _check_places(step: Path, manifest: Manifest, folder: Path, max_pixels: int) -> None:
    """Check that every file that the manifest names lies in the folder, links followed, and is not too large."""
    named = [("camera", manifest.camera.resolution), *((f"other_cameras[{index}]", other.resolution)
                                                       for index, other in enumerate(manifest.other_cameras))]
    for camera, (width, height) in named:
        if width * height > max_pixels:
            raise ImageError(f"{step / FILE_NAME}: {camera}.resolution: {width}x{height} is more than {max_pixels} pixels")
    capture = Capture(step, manifest)
    for field, name in capture.files():
        path = capture.file(name)
        with storage("read", path):
            if not path.exists() and not path.is_symlink():
                continue  # opening the capture says so
            _check_place(path, folder, f"{step / FILE_NAME}: {field}: {name}")
        if path.suffix.lower() == ".npy":
            _check_array(path, max_pixels)
        else:
            _check_image(path, max_pixels)


def _check_place(path: Path, folder: Path, named: str) -> None:
    place = resolved(path)
    if place is None:
        raise ManifestError(f"{named} leads nowhere")
    if not place.is_relative_to(folder.resolve()):
        raise ManifestError(f"{named} leads out of the capture's folder")
    if not place.is_file():  # to open a pipe would wait for ever
        raise ManifestError(f"{named} is no file")


def _check_image(path: Path, max_pixels: int) -> images.ImageHeader:
    if path.suffix.lower() == ".jxl":
        _check_size(path, *integrity.jxl_resolution(path), 1, max_pixels)
    header = images.read_header(path)
    _check_size(path, header.width, header.height, header.stored, max_pixels)
    return header


def _check_size(path: Path, width: int, height: int, channels: int, max_pixels: int) -> None:
    if width * height > max_pixels:
        raise ImageError(f"{path}: has {width}x{height} pixels, {max_pixels} are allowed")
    if width * height * channels > MAX_CHANNELS * max_pixels:
        raise ImageError(f"{path}: has {width}x{height} pixels of {channels} channels, {max_pixels} of {MAX_CHANNELS} are allowed")


def _check_array(path: Path, max_pixels: int) -> None:
    """Check the header of a .npy file: real numbers, in two or three dimensions, as many as its bytes hold."""
    with inputs.opened(path) as source:
        shape = array_shape(path, source.file, max_pixels)
    if len(shape) not in (2, 3) or min(shape) < 1:
        raise ImageError(f"{path}: has the shape {shape}: give (rows, cols) or (rows, cols, bins)")
