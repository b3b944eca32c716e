"""Faults of the arrays of a .glb: numbers that are not finite, faces of vertices that are not there, and attributes of other lengths.

Source: glTF 2.0 Specification, 3.6.2 "Accessors" and 3.7.2 "Meshes".
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from pygltflib import TRIANGLES

from service.asset.gltf.container import ELEMENT_SIZES, GlbContents

FINITE = ("POSITION", "NORMAL", "TANGENT", "TEXCOORD")
"""Attributes that must be numbers; others, as the σ of a depth, may be unknown."""
TYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}


def geometry_faults(path: Path, contents: GlbContents) -> Iterator[str]:
    """Yield a sentence for each fault of the primitives, whose accessors lie within the file."""
    document = contents.document
    for number, mesh in enumerate(document.meshes):
        for primitive in mesh.primitives:
            where = mesh.name or f"mesh {number}"
            attributes = {name: index for name, index in vars(primitive.attributes).items() if index is not None}
            used = [*attributes.values(), *([] if primitive.indices is None else [primitive.indices])]
            if lost := [index for index in used if not 0 <= index < len(document.accessors)]:
                yield f"{where}: refers to accessor {lost[0]}, which is not there"
                continue
            vertices = document.accessors[attributes["POSITION"]].count
            for name, index in attributes.items():
                if (count := document.accessors[index].count) != vertices:
                    yield f"{where}: has {vertices} vertices and {count} values of {name}"
                values = _values(path, contents, index) if name.partition("_")[0] in FINITE else None
                if values is not None and (bad := int((~np.isfinite(values)).any(axis=1).sum())):
                    yield f"{where}: {bad} of its {len(values)} values of {name} are not finite (NaN or infinity)"
            corners = None if primitive.indices is None else _values(path, contents, primitive.indices)
            if corners is not None and len(corners) and corners.max() >= vertices:
                yield f"{where}: has a face of vertex {corners.max()}, and {vertices} vertices"
            count = vertices if primitive.indices is None else document.accessors[primitive.indices].count
            if primitive.mode in (None, TRIANGLES) and count % 3:
                yield f"{where}: has {count} corners, which make no whole triangles"


def _values(path: Path, contents: GlbContents, number: int) -> np.ndarray | None:
    """Return the values of an accessor [n, components]; None: they are sparse, compressed, or in another file."""
    accessor = contents.document.accessors[number]
    if accessor.bufferView is None or accessor.sparse is not None or not accessor.count:
        return None
    view, kind = contents.document.bufferViews[accessor.bufferView], np.dtype(TYPES[accessor.componentType])
    if view.buffer or contents.document.buffers[0].uri:
        return None
    stored = np.memmap(path, np.uint8, "r")
    start, size = contents.data_start + (view.byteOffset or 0) + (accessor.byteOffset or 0), ELEMENT_SIZES[accessor.type]
    return np.ndarray((accessor.count, size), kind, stored, start, (view.byteStride or kind.itemsize * size, kind.itemsize))
