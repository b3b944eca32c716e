"""Inspection of a .glb file for relit inspect: the facts that a technical director checks, read from the document and the image headers.

Source: glTF 2.0 Specification, 3.5.3 "Transformations", 3.6.2 "Accessors"; PNG Specification, 11.2.1 "IHDR".
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pygltflib import GLTF2, Node

from service.asset.errors import AssetError
from service.gltf.container import COMPONENT_BYTES, ELEMENT_SIZES, GlbContents, read_glb
from stage.errors import storage

MODES = ("points", "lines", "line loop", "line strip", "triangles", "triangle strip", "triangle fan")
"""Names of the modes of primitives, 0 to 6 (3.7.2.1)."""

_PNG_HEADER = struct.Struct(">8s4x4sIIBB")
_PNG_CHANNELS = {0: 1, 2: 3, 3: 3, 4: 2, 6: 4}
"""Channels by colour type; a palette stands for three."""


@dataclass(frozen=True)
class PrimitiveFacts:
    """A mesh or points."""

    mesh: str
    mode: str
    vertices: int
    faces: int
    """Triangles; 0 for points and lines."""
    attributes: tuple[str, ...]
    material: str | None


@dataclass(frozen=True)
class ImageFacts:
    """An image of a material."""

    name: str
    size_bytes: int
    width: int | None
    """None: it is no PNG, whose header is read."""
    height: int | None
    channels: int | None
    depth: int | None
    """Bits a channel."""


@dataclass(frozen=True)
class LookFacts:
    """A material."""

    name: str
    values: dict[str, Any]
    """Factors, and the values of extensions."""
    images: dict[str, ImageFacts]
    """By the input that reads them."""


@dataclass(frozen=True)
class GlbInspection:
    """What a .glb file holds, and what is wrong with it."""

    file: str
    size_bytes: int
    asset_info: dict[str, str]
    """Generator and version of the format, identifier and version of the asset."""
    extensions: tuple[str, ...]
    extent_m: tuple[tuple[float, ...], tuple[float, ...]] | None
    """Lowest and highest corner of the bounding box in the world, metres: of the boxes of all primitives."""
    primitives: tuple[PrimitiveFacts, ...]
    materials: tuple[LookFacts, ...]
    cameras: tuple[str, ...]
    provenance: dict[str, str]
    """Extras of the root nodes."""
    errors: tuple[str, ...]


def inspect_glb(path: Path) -> GlbInspection:
    """Read what a .glb file holds.

    Raises:
        AssetError: it is not a .glb file, or a damaged one.
        StorageError: it cannot be read.
    """
    if path.is_dir() or not path.exists():
        raise AssetError(f"{path} is {'a folder' if path.is_dir() else 'not there'}: give a .glb file")
    with storage("read", path):
        contents = read_glb(path)
    try:
        return _inspect(path, contents, [_image(path, contents, number) for number in range(len(contents.document.images))])
    except (KeyError, IndexError, TypeError, AttributeError, ValueError, RecursionError) as error:
        raise AssetError(f"{path}: is damaged: its document refers to what it does not hold ({error})") from error


def _inspect(path: Path, contents: GlbContents, images: list[ImageFacts]) -> GlbInspection:
    document = contents.document
    roots = [document.nodes[number] for scene in document.scenes[:1] for number in scene.nodes or ()]
    primitives = [(mesh.name or f"mesh {number}", each) for number, mesh in enumerate(document.meshes) for each in mesh.primitives]
    info = {"generator": document.asset.generator, "glTF": document.asset.version, **(document.asset.extras or {})}
    return GlbInspection(
        file=str(path), size_bytes=path.stat().st_size, asset_info={key: str(value) for key, value in info.items() if value},
        extensions=tuple(document.extensionsUsed or ()), extent_m=_extent(document, roots),
        primitives=tuple(_primitive(document, name, primitive) for name, primitive in primitives),
        materials=tuple(_look(document, number, images) for number in range(len(document.materials))),
        cameras=tuple(_camera(camera) for camera in document.cameras),
        provenance={key: str(value) for root in roots for key, value in (root.extras or {}).items()},
        errors=tuple(_faults(contents)))


def _primitive(document: GLTF2, name: str, primitive: Any) -> PrimitiveFacts:
    mode = MODES[4 if primitive.mode is None else primitive.mode]
    attributes = {key: number for key, number in vars(primitive.attributes).items() if number is not None}
    vertices = document.accessors[attributes["POSITION"]].count if "POSITION" in attributes else 0
    corners = document.accessors[primitive.indices].count if primitive.indices is not None else vertices
    faces = {"triangles": corners // 3, "triangle strip": corners - 2, "triangle fan": corners - 2}.get(mode, 0)
    material = document.materials[primitive.material].name if primitive.material is not None else None
    return PrimitiveFacts(name, mode, vertices, faces, tuple(attributes), material)


def _look(document: GLTF2, number: int, images: list[ImageFacts]) -> LookFacts:
    """Return the factors and images of a material and its extensions."""
    material = document.materials[number]
    surface = material.pbrMetallicRoughness
    values: dict[str, Any] = {"doubleSided": material.doubleSided, "alphaMode": material.alphaMode}
    found: dict[str, ImageFacts] = {}
    if surface is not None:
        values |= {name: getattr(surface, name) for name in ("baseColorFactor", "metallicFactor", "roughnessFactor")}
    inputs: list[tuple[str, Any]] = [(name, getattr(holder, name, None)) for holder in (surface, material)
                                     for name in ("baseColorTexture", "metallicRoughnessTexture", "normalTexture", "occlusionTexture",
                                                  "emissiveTexture")]
    for extension, fields in (material.extensions or {}).items():
        values |= {f"{extension}.{name}": value for name, value in fields.items() if not isinstance(value, dict)} or {extension: True}
        inputs += [(f"{extension}.{name}", value) for name, value in fields.items() if isinstance(value, dict)]
    for name, info in inputs:
        index = info.get("index") if isinstance(info, dict) else getattr(info, "index", None)
        if index is not None and document.textures[index].source is not None:
            found[name] = images[document.textures[index].source]
    return LookFacts(material.name or f"material {number}", {name: value for name, value in values.items() if value is not None}, found)


def _image(path: Path, contents: GlbContents, number: int) -> ImageFacts:
    """Return the facts of an image within the file, or of one that lies elsewhere without its size."""
    image = contents.document.images[number]
    name = image.name or image.uri or f"image {number}"
    if image.bufferView is None:
        return ImageFacts(name, 0, None, None, None, None)
    view = contents.document.bufferViews[image.bufferView]
    with open(path, "rb") as stream:
        stream.seek(contents.data_start + (view.byteOffset or 0))
        start = stream.read(_PNG_HEADER.size)
    if len(start) < _PNG_HEADER.size or start[:8] != b"\x89PNG\r\n\x1a\n":
        return ImageFacts(name, view.byteLength, None, None, None, None)
    _, _, width, height, depth, colour_type = _PNG_HEADER.unpack(start)
    return ImageFacts(name, view.byteLength, width, height, _PNG_CHANNELS.get(colour_type), depth)


def _camera(camera: Any) -> str:
    lens = camera.orthographic
    if lens is not None:
        return f"{camera.name or 'camera'}, orthographic, {2 * lens.xmag:.4g} × {2 * lens.ymag:.4g} m"
    return f"{camera.name or 'camera'}, perspective, {np.degrees(camera.perspective.yfov):.4g}° high"


def _extent(document: GLTF2, roots: list[Node]) -> tuple[tuple[float, ...], tuple[float, ...]] | None:
    """Return the bounding box of the boxes of all primitives, in the world."""
    corners = [(matrix @ np.append(corner, 1))[:3] for root in roots for node, matrix in _placed(document, root, np.eye(4))
               if node.mesh is not None for box in _boxes(document, node.mesh)
               for corner in np.stack(np.meshgrid(*np.transpose(box), indexing="ij"), axis=-1).reshape(-1, 3)]
    if not corners:
        return None
    return tuple(np.min(corners, axis=0).tolist()), tuple(np.max(corners, axis=0).tolist())


def _boxes(document: GLTF2, mesh: int) -> Iterator[np.ndarray]:
    """Yield the box [2, 3] of each primitive of a mesh."""
    for primitive in document.meshes[mesh].primitives:
        if primitive.attributes.POSITION is not None:
            accessor = document.accessors[primitive.attributes.POSITION]
            if len(accessor.min or ()) == len(accessor.max or ()) == 3:
                yield np.array([accessor.min, accessor.max])


def _placed(document: GLTF2, node: Node, world: np.ndarray) -> Iterator[tuple[Node, np.ndarray]]:
    """Yield a node and those below it, each with its world matrix [4, 4]."""
    if node.matrix is not None:
        own = np.array(node.matrix, dtype=np.float64).reshape(4, 4).T
    else:
        x, y, z, w = node.rotation or (0, 0, 0, 1)
        own = np.eye(4)
        own[:3, :3] = np.array([[1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                                [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                                [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)]]) * np.array(node.scale or (1, 1, 1))
        own[:3, 3] = node.translation or (0, 0, 0)
    yield node, world @ own
    for child in node.children or ():
        yield from _placed(document, document.nodes[child], world @ own)


def _faults(contents: GlbContents) -> Iterator[str]:
    """Yield what reaches beyond its container."""
    document = contents.document
    for number, view in enumerate(document.bufferViews):
        if view.buffer == 0 and (view.byteOffset or 0) + view.byteLength > contents.data_size:
            yield f"bufferView {number} reaches beyond the {contents.data_size} bytes of the buffer"
    for number, accessor in enumerate(document.accessors):
        if accessor.bufferView is not None:
            element = COMPONENT_BYTES[accessor.componentType] * ELEMENT_SIZES[accessor.type]
            stride = document.bufferViews[accessor.bufferView].byteStride or element
            if (accessor.byteOffset or 0) + stride * (accessor.count - 1) + element > document.bufferViews[accessor.bufferView].byteLength:
                yield f"accessor {number} reaches beyond its bufferView"
