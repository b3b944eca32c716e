"""Faults of the arrays of a .glb: numbers that are not finite, faces of vertices that are not there, attributes of other lengths, bounds
that the values do not have, directions that are not of length 1, and textures without coordinates.

Source: glTF 2.0 Specification, 3.6.2 "Accessors" and 3.7.2 "Meshes".
"""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from pygltflib import GLTF2, TRIANGLES, Material

from service.asset.content.surface import length_fault
from service.asset.gltf.container import COMPONENT_TYPES, ELEMENT_SIZES, GlbContents

FINITE = ("POSITION", "NORMAL", "TANGENT", "TEXCOORD")
"""Attributes that must be numbers; others, as the σ of a depth, may be unknown."""
DIRECTIONS = ("NORMAL", "TANGENT")
"""Attributes of which the first three components are of length 1."""
BOUNDS_TOLERANCE = 1e-4
"""The largest deviation of min and max from the values, as a part of their range: more than decimals of a document round."""
FLOAT32 = 5126


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
                if values is not None and document.accessors[index].componentType == FLOAT32:
                    yield from _value_faults(f"{where}: {name}", name, values, document.accessors[index].min, document.accessors[index].max)
                if values is not None and (bad := int((~np.isfinite(values)).any(axis=1).sum())):
                    yield f"{where}: {bad} of its {len(values)} values of {name} are not finite (NaN or infinity)"
            for number_of_set, inputs in sorted(_coordinates(document, primitive.material).items()):
                if f"TEXCOORD_{number_of_set}" not in attributes:
                    yield f"{where}: has no TEXCOORD_{number_of_set}, by which its material reads {', '.join(inputs)}: no texture shows"
            corners = None if primitive.indices is None else _values(path, contents, primitive.indices)
            if corners is not None and len(corners) and corners.max() >= vertices:
                yield f"{where}: has a face of vertex {corners.max()}, and {vertices} vertices"
            count = vertices if primitive.indices is None else document.accessors[primitive.indices].count
            if primitive.mode in (None, TRIANGLES) and count % 3:
                yield f"{where}: has {count} corners, which make no whole triangles"


def _value_faults(where: str, name: str, values: np.ndarray, low: list[float] | None, high: list[float] | None) -> Iterator[str]:
    """Yield what is wrong with float values [n, components] of an attribute and with the bounds that their accessor gives."""
    if name == "POSITION" and not (low and high):
        yield f"{where}: its accessor has no min and max, which positions need"
    if np.isfinite(values).all():
        edges = np.stack([values.min(axis=0), values.max(axis=0)])
        slack = BOUNDS_TOLERANCE * float(np.ptp(edges)) + np.finfo(np.float32).tiny
        for words, given, edge in (("min", low, edges[0]), ("max", high, edges[1])):
            if given and (len(given) != len(edge) or np.abs(np.subtract(given, edge)).max() > slack):
                yield f"{where}: {words} of its accessor is {_rounded(given)}, and that of its values {_rounded(edge)}"
    if name in DIRECTIONS and (fault := length_fault(values[:, :3])):
        yield f"{where}: {fault}"
    if name == "TANGENT" and (bad := int((abs(values[:, 3]) != 1).sum())):
        yield f"{where}: the fourth component of {bad} of its {len(values)} values, the sense of the bitangent, is neither 1 nor -1"


def _rounded(values: Sequence[float] | np.ndarray) -> str:
    return f"({', '.join(f'{float(value):.5g}' for value in values)})"


def _coordinates(document: GLTF2, number: int | None) -> dict[int, list[str]]:
    """Return the textures of a material by the number of the texture coordinates that they are read with."""
    if number is None or not 0 <= number < len(document.materials):
        return {}
    material: Material = document.materials[number]
    found: dict[int, list[str]] = {}
    for holder in (material.pbrMetallicRoughness, material):
        for name, info in vars(holder).items() if holder is not None else ():
            if name.endswith("Texture") and info is not None:
                moved = (info.extensions or {}).get("KHR_texture_transform", {}).get("texCoord")
                found.setdefault(moved if moved is not None else info.texCoord or 0, []).append(name)
    return found


def _values(path: Path, contents: GlbContents, number: int) -> np.ndarray | None:
    """Return the values of an accessor [n, components]; None: they are sparse, compressed, or in another file."""
    accessor = contents.document.accessors[number]
    if accessor.bufferView is None or accessor.sparse is not None or not accessor.count:
        return None
    view, kind = contents.document.bufferViews[accessor.bufferView], COMPONENT_TYPES[accessor.componentType]
    if view.buffer or contents.document.buffers[0].uri:
        return None
    stored = np.memmap(path, np.uint8, "r")
    start, size = contents.data_start + (view.byteOffset or 0) + (accessor.byteOffset or 0), ELEMENT_SIZES[accessor.type]
    return np.ndarray((accessor.count, size), kind, stored, start, (view.byteStride or kind.itemsize * size, kind.itemsize))
