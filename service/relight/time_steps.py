"""The captures that frames are made from: one, or a sequence with one capture for each time step; and their files.

It loads nothing that relights: the check of an upload asks for them too.
"""

from collections.abc import Iterator
from pathlib import Path

from service.errors import RequestError
from stage.capture.capture import Capture
from stage.capture.manifest import FILE_NAME, read_manifest
from stage.capture.sequence import difference, is_sequence, read_sequence

SHARED = {"camera.resolution": "resolution", "color_space": "colour space"}
"""Fields of the manifest that the captures of a relit sequence share, and their words."""


def time_steps(path: Path) -> list[Path]:
    """Return the captures that frames are made from, in the order of the file, else of name; the path alone where it is no sequence.

    Args:
        path: a capture, or a sequence: a sequence.json, its folder, or a folder without capture.json whose sub-folders have one. Its
            captures must have one resolution and colour space.
    """
    if not is_sequence(path):
        return [path]
    folders = [step.folder for step in read_sequence(path).steps]
    first = read_manifest(folders[0] / FILE_NAME)
    for folder in folders[1:]:
        if (apart := difference(read_manifest(folder / FILE_NAME), first, SHARED)) is not None:
            raise RequestError(f"{folder}: is {apart.value}, {folders[0].name} {apart.other}: the captures of a sequence share one "
                               f"{SHARED[apart.field]}")
    return folders


def capture_files(folder: Path) -> Iterator[Path]:
    """Yield every file that a capture is read from; where there is no manifest, nothing: opening the capture says so."""
    manifest = folder if folder.name == FILE_NAME else folder / FILE_NAME
    if manifest.is_file():
        yield manifest
        capture = Capture(manifest.parent, read_manifest(manifest))
        for _, name in capture.files():
            yield capture.file(name)
