"""The .glb file: a glTF document and its binary data, which is streamed into the file and never held as a whole.

Source: glTF 2.0 Specification, 3.6 "Binary Data Storage" and 4 "GLB File Format Specification".
"""

import shutil
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np
from pygltflib import GLTF2, Accessor, Buffer, BufferView, Image

from service.errors import AssetError
from stage.files import folder_beside, replacing

MAX_FILE_BYTES = 2**32 - 1
"""The header of the file gives its length in 32 bits (4.4.2)."""

ALIGNMENT = 4
"""Bytes: the start of every chunk and of every accessor (3.6.2.4 and 4.4.3)."""

_HEADER, _CHUNK_HEADER = struct.Struct("<4sII"), struct.Struct("<I4s")
_MAGIC, _VERSION = b"glTF", 2
_JSON, _BIN = b"JSON", b"BIN\0"

COMPONENT_TYPES = {code: np.dtype(kind) for code, kind in (
    (5120, "i1"), (5121, "u1"), (5122, "<i2"), (5123, "<u2"), (5125, "<u4"), (5126, "<f4"))}
"""The NumPy type of each code of a type of component (3.6.2.2, "Accessor Data Types")."""
ELEMENT_SIZES = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
"""Components of each type of element."""
_CODES = {kind: code for code, kind in COMPONENT_TYPES.items()}
_ELEMENT_TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}


class Glb:
    """A glTF document in the making: its JSON objects, and the arrays and files that its buffer will hold."""

    def __init__(self) -> None:
        self.document = GLTF2()
        self._parts: list[np.ndarray | Path] = []
        self._size = 0

    def add_array(self, values: np.ndarray, *, target: int, bounds: bool = False) -> int:
        """Add an array and return the number of its accessor.

        Args:
            values: [n] or [n, 2, 3 or 4] uint8, uint16, uint32 or float32; kept until the file is written.
            target: what the array is for: ARRAY_BUFFER or ELEMENT_ARRAY_BUFFER of pygltflib.
            bounds: write the least and the greatest value of each component, as positions need.
        """
        values = np.ascontiguousarray(values, dtype=values.dtype.newbyteorder("<"))
        components = values.shape[1] if values.ndim == 2 else 1
        least, greatest = (np.atleast_1d(edge).tolist() for edge in (values.min(axis=0), values.max(axis=0))) if bounds else ([], [])
        self.document.accessors.append(Accessor(
            bufferView=self._add_part(values, values.nbytes, target), componentType=_CODES[values.dtype],
            normalized=False, count=len(values), type=_ELEMENT_TYPES[components], min=least, max=greatest))
        return len(self.document.accessors) - 1

    def add_png(self, file: Path) -> int:
        """Add a PNG file and return the number of the image; the file is read when the .glb is written."""
        view = self._add_part(file, file.stat().st_size, None)
        self.document.images.append(Image(bufferView=view, mimeType="image/png", name=file.stem))
        return len(self.document.images) - 1

    def write(self, path: Path) -> None:
        """Write the file, which can hold 4 GiB."""
        self.document.buffers = [Buffer(byteLength=self._size)]
        text = self.document.gltf_to_json(separators=(",", ":"), indent=None).encode()
        text += b" " * (-len(text) % ALIGNMENT)
        length = _HEADER.size + _CHUNK_HEADER.size + len(text) + _CHUNK_HEADER.size + self._size
        if length > MAX_FILE_BYTES:
            raise AssetError(f"the asset has {length / 2**30:.1f} GiB, more than the 4 GiB that a .glb can hold: export a .usdc")
        with open(path, "wb") as stream:
            stream.write(_HEADER.pack(_MAGIC, _VERSION, length) + _CHUNK_HEADER.pack(len(text), _JSON) + text)
            stream.write(_CHUNK_HEADER.pack(self._size, _BIN))
            for part in self._parts:
                _append(stream, part)
                stream.write(bytes(-stream.tell() % ALIGNMENT))

    def _add_part(self, part: np.ndarray | Path, size: int, target: int | None) -> int:
        """Add data to the buffer and return the number of its view."""
        self.document.bufferViews.append(BufferView(buffer=0, byteOffset=self._size, byteLength=size, target=target))
        self._parts.append(part)
        self._size += size + -size % ALIGNMENT
        return len(self.document.bufferViews) - 1


@contextmanager
def writing_glb(target: Path) -> Iterator[tuple[Glb, Path]]:
    """Yield an empty document and a folder for its images; the file replaces `target`, whole or not at all, when the block ends."""
    with replacing(target) as temporary, folder_beside(target) as folder:
        glb = Glb()
        yield glb, folder
        glb.write(temporary)


class GlbContents(NamedTuple):
    """A .glb file without its binary data."""

    document: GLTF2
    data_start: int  # byte of the file at which the buffer begins
    data_size: int  # its bytes; 0: there is no buffer
    faults: tuple[str, ...]  # sentences about lengths that the file does not have


def read_glb(path: Path) -> GlbContents:
    """Read the document of a .glb file."""
    start = _HEADER.size + _CHUNK_HEADER.size
    with open(path, "rb") as stream:
        head = stream.read(start)
        size = path.stat().st_size
        if len(head) < start or head[:4] != _MAGIC:
            raise AssetError(f"{path}: is not a .glb file")
        _, version, length = _HEADER.unpack_from(head)
        text_length, kind = _CHUNK_HEADER.unpack_from(head, _HEADER.size)
        if version != _VERSION or kind != _JSON:
            raise AssetError(f"{path}: is not glTF of version {_VERSION}: its header says {version}")
        if length > size or text_length > size:
            raise AssetError(f"{path}: is cut off: it has {size} of {length} bytes")
        text, next_head = stream.read(text_length), stream.read(_CHUNK_HEADER.size)
    data_start = start + text_length + _CHUNK_HEADER.size
    data_size, kind = _CHUNK_HEADER.unpack(next_head) if len(next_head) == _CHUNK_HEADER.size else (0, _BIN)
    faults = []
    if length != size:
        faults.append(f"the header says that the file has {length} bytes, and it has {size}")
    if kind != _BIN or data_start + data_size > size:
        faults.append(f"the chunk behind the document says {data_size} bytes of type {kind!r}: {max(size - data_start, 0)} bytes follow")
        data_size = min(data_size, max(size - data_start, 0)) if kind == _BIN else 0
    try:
        return GlbContents(GLTF2.gltf_from_json(text.decode()), data_start, data_size, tuple(faults))
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise AssetError(f"{path}: holds no glTF document that can be read: {error}") from error


def _append(stream: BinaryIO, part: np.ndarray | Path) -> None:
    if isinstance(part, Path):
        with open(part, "rb") as source:
            shutil.copyfileobj(source, stream)
    else:
        stream.write(part.data)
