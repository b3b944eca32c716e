"""Inspection of a .glb file for relit inspect: what it holds, and what reaches beyond the file; the validator of Khronos looks deeper.

Source: glTF 2.0 Specification, 3.6 "Binary Data Storage", 4.4 "Binary glTF Layout".
"""

import math
from base64 import b64decode
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import unquote, unquote_to_bytes

import numpy as np
from pygltflib import GLTF2, POINTS, TRIANGLES

from service.asset.content.surface import Inspection, Part, image_facts, size_doubts, texture_faults
from service.asset.gltf.container import COMPONENT_TYPES, ELEMENT_SIZES, GlbContents, read_glb
from service.asset.gltf.geometry_faults import geometry_faults
from service.errors import AssetError
from stage.errors import storage

SIGNATURES = {"png": b"\x89PNG\r\n\x1a\n", "jpeg": b"\xff\xd8\xff", "ktx2": b"\xabKTX 20\xbb"}
"""The first bytes of images, by the end of their media types."""


def inspect_glb(path: Path) -> Inspection:
    """Read what a .glb file holds."""
    with storage("read", path):
        contents = read_glb(path)
        try:
            return _inspect(path, contents)
        except (KeyError, IndexError, TypeError, AttributeError, ValueError, RecursionError) as error:
            raise AssetError(f"{path}: is damaged: its document refers to what it does not hold ({error})") from error


def _inspect(path: Path, contents: GlbContents) -> Inspection:
    document = contents.document
    roots = [document.nodes[number] for scene in document.scenes[:1] for number in scene.nodes or ()]
    info = {"generator": document.asset.generator, "glTF": document.asset.version, **(document.asset.extras or {})}
    facts = {"asset_info": {key: str(value) for key, value in info.items() if value}, "extensions": list(document.extensionsUsed or ())}
    provenance = {key: str(value) for root in roots for key, value in (root.extras or {}).items()}
    parts = [*_primitives(document), *_materials(path, contents), *(
        Part("camera", camera.name or "camera", "", {"orthographic_m": [2 * flat.xmag, 2 * flat.ymag]}
             if (flat := camera.orthographic) else {"degrees_high": math.degrees(camera.perspective.yfov)}) for camera in document.cameras)]
    beside = [path.parent / unquote(each.uri) for each in (*document.buffers, *document.images)
              if each.uri and not each.uri.startswith("data:")]
    warnings = [f"the asset needs {file}, which lies outside of it" for file in beside]
    errors = [f"{file} is not there, and the document refers to it" for file in beside if not file.is_file()]
    corners = [corner for part in parts if part.kind == "mesh" for corner in (part.facts["low"], part.facts["high"])]
    if corners and all(corner and len(corner) == 3 for corner in corners) and all(
            node.matrix is None and node.scale is None for node in document.nodes):
        warnings += size_doubts(np.array(corners), "glTF is in metres")
    errors += [f"{part.name}: {part.facts['file']} is declared as {part.facts['declared']}, and is {part.facts['format']}: correct its "
               "mimeType" for part in parts if "declared" in part.facts]
    size = path.stat().st_size + sum(file.stat().st_size for file in beside if file.is_file())
    return Inspection(str(path), size, facts, tuple(parts), provenance, tuple(warnings),
                      (*contents.faults, *errors, *(list(_faults(contents)) or geometry_faults(path, contents)), *texture_faults(parts)))


def _primitives(document: GLTF2) -> Iterator[Part]:
    for number, mesh in enumerate(document.meshes):
        for primitive in mesh.primitives:
            attributes = {name: index for name, index in vars(primitive.attributes).items() if index is not None}
            places = document.accessors[attributes["POSITION"]]
            corners = places.count if primitive.indices is None else document.accessors[primitive.indices].count
            faces = {"faces": corners // 3} if primitive.mode in (None, TRIANGLES) else {"mode": primitive.mode}
            material = None if primitive.material is None else document.materials[primitive.material].name
            yield Part("points" if primitive.mode == POINTS else "mesh", mesh.name or f"mesh {number}", "", {
                "vertices": places.count, **faces, "low": places.min, "high": places.max, "material": material,
                "attributes": list(attributes)})


def _materials(path: Path, contents: GlbContents) -> Iterator[Part]:
    """Yield each material with its factors and those of its extensions, and the image of each of its inputs."""
    document = contents.document
    for number, material in enumerate(document.materials):
        inputs = {name: value for holder in (material.pbrMetallicRoughness, material) if holder for name, value in vars(holder).items()}
        for extension, fields in (material.extensions or {}).items():
            inputs |= {f"{extension}.{name}": value for name, value in fields.items()} or {extension: True}
        name = inputs.pop("name") or f"material {number}"
        yield Part("material", name, "", {key: value for key, value in inputs.items() if isinstance(value, int | float | str | list)})
        for key, value in inputs.items():
            if key.endswith("Texture") and value is not None:
                source = document.textures[value["index"] if isinstance(value, dict) else value.index].source
                yield from () if source is None else [Part("texture", f"{name} {key}", "", _image(path, contents, source))]


def _image(path: Path, contents: GlbContents, number: int) -> dict[str, Any]:
    """Return the facts of an image within the file, or the name of one beside it."""
    image = contents.document.images[number]
    head, _, text = (image.uri or "").partition(",")
    within = head.startswith("data:")
    kind = (head.removeprefix("data:").partition(";")[0] if within else image.mimeType or "").rpartition("/")[2]
    name = image.name or (None if within else image.uri) or f"image {number}"
    if within:
        try:
            data = b64decode(text, validate=True) if head.endswith(";base64") else unquote_to_bytes(text)
        except ValueError:  # no base64
            data = b""
        return {"file": name, **_facts_of(data, name, kind)}
    if image.bufferView is None:
        return {"file": name}
    view = contents.document.bufferViews[image.bufferView]
    with open(path, "rb") as stream:
        stream.seek(contents.data_start + (view.byteOffset or 0))
        return {"file": name, **_facts_of(stream.read(min(view.byteLength, contents.data_size)), name, kind)}


def _facts_of(data: bytes, name: str, kind: str) -> dict[str, Any]:
    """Return the facts of an image, read as what it is; what it is and is declared to be, where these differ."""
    found = next((format_ for format_, begin in SIGNATURES.items() if data.startswith(begin)), None)
    differs = found is not None and kind.lower().replace("jpg", "jpeg") != found
    return image_facts(data, f"{name}.{found or kind}") | ({"declared": kind or "nothing", "format": found} if differs else {})


def _faults(contents: GlbContents) -> Iterator[str]:
    document = contents.document
    children = [child for node in document.nodes for child in node.children or ()]
    for kind, used, there in (("node", children, document.nodes), ("mesh", [node.mesh for node in document.nodes], document.meshes)):
        yield from (f"the nodes refer to {kind} {each}, which is not there" for each in used if each is not None and each >= len(there))
    if len(set(children)) < len(children) or any(root in children for scene in document.scenes for root in scene.nodes or ()):
        yield "the nodes are no tree: one has several parents, or a root has one"
    for number, view in enumerate(document.bufferViews):
        if view.buffer == 0 and (view.byteOffset or 0) + view.byteLength > contents.data_size:
            yield f"bufferView {number} reaches beyond the {contents.data_size} bytes of the buffer"
    for number, accessor in enumerate(document.accessors):
        if accessor.bufferView is not None:
            element = COMPONENT_TYPES[accessor.componentType].itemsize * ELEMENT_SIZES[accessor.type]
            stride = document.bufferViews[accessor.bufferView].byteStride or element
            if (accessor.byteOffset or 0) + stride * (accessor.count - 1) + element > document.bufferViews[accessor.bufferView].byteLength:
                yield f"accessor {number} reaches beyond its bufferView"
