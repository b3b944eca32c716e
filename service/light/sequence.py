"""A capture, or a sequence of captures: one a time step, in order of name, each opened only while its frame is made."""

from collections.abc import Iterator
from pathlib import Path

from service.errors import RequestError
from stage.capture import Capture
from stage.errors import storage
from stage.manifest import FILE_NAME, read_manifest


def time_steps(path: Path) -> list[Path]:
    """The capture folders that frames are taken from.

    Args:
        path: a capture, or a folder without capture.json whose sub-folders have one.

    Returns:
        The captures in order of name; the path itself where it is no sequence.

    Raises:
        RequestError: two captures differ in resolution or colour space.
        ManifestError: a capture.json is wrong; names the field.
        StorageError: a folder cannot be read.
    """
    with storage("read", path):
        if path.name == FILE_NAME or not path.is_dir() or (path / FILE_NAME).exists():
            return [path]
        steps = sorted(folder for folder in path.iterdir() if (folder / FILE_NAME).is_file())
    if not steps:
        return [path]
    first = read_manifest(steps[0] / FILE_NAME)
    for step in steps[1:]:
        manifest = read_manifest(step / FILE_NAME)
        for what, theirs, ours in (("resolution", _size(manifest.camera.resolution), _size(first.camera.resolution)),
                                   ("colour space", manifest.color_space, first.color_space)):
            if theirs != ours:
                raise RequestError(f"{step}: is {theirs}, {steps[0].name} {ours}: the captures of a sequence share one {what}")
    return steps


def capture_files(folder: Path) -> Iterator[Path]:
    """Every file that a capture is read from; those of a bad manifest are left to whoever opens the capture.

    Raises:
        ManifestError: the manifest is wrong; names the field.
    """
    manifest = folder if folder.name == FILE_NAME else folder / FILE_NAME
    if manifest.is_file():
        yield manifest
        capture = Capture(manifest.parent, read_manifest(manifest))
        for _, name in capture.files():
            yield capture.file(name)


def _size(resolution: tuple[int, int]) -> str:
    return "x".join(map(str, resolution))
