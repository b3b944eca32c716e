"""Pack the extension for Blender as one zip, the same bytes from the same version."""

import ast
import re
import zipfile
from pathlib import Path

from service import __version__
from service.errors import RequestError
from service.requests.export import BlenderExtensionRequest
from stage.files import replacing

SOURCES = Path(__file__).parent / "extension"
MANIFEST = "blender_manifest.toml"
OLDEST_TIME = (1980, 1, 1, 0, 0, 0)
"""The time of every file in the zip, the first that the format has, so that the same sources give the same bytes."""


def pack(request: BlenderExtensionRequest) -> Path:
    """Write the extension, whole or not at all, and return its path.

    Raises:
        RequestError: the file would not end with .zip.
        StorageError: it cannot be written.
    """
    if request.out.suffix.lower() != ".zip":
        raise RequestError(f"--out {request.out}: Blender installs extensions from files that end with .zip")
    version = re.match(r"\d+\.\d+\.\d+", __version__)
    source = ast.parse((SOURCES / "__init__.py").read_text(encoding="utf-8"))
    oldest, = (ast.literal_eval(node.value) for node in source.body
               if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "OLDEST")
    words = {"{version}": version[0] if version else "0.0.0", "{oldest}": ".".join(map(str, oldest))}
    with replacing(request.out) as temporary, zipfile.ZipFile(temporary, "w") as packed:
        for path in sorted((*SOURCES.glob("*.py"), SOURCES / MANIFEST)):
            text = path.read_text(encoding="utf-8")
            if path.name == MANIFEST:
                for word, value in words.items():
                    text = text.replace(word, value)
            entry = zipfile.ZipInfo(path.name, OLDEST_TIME)
            entry.compress_type, entry.external_attr, entry.create_system = zipfile.ZIP_DEFLATED, 0o644 << 16, 3
            packed.writestr(entry, text)
    return request.out
