"""Meshes and points as primitives of glTF.

Source: glTF 2.0 Specification, 3.7.2 "Meshes".
"""

import numpy as np
from pygltflib import ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER, POINTS, TRIANGLES, Attributes, Primitive

from service.asset.content.mesh import SurfaceMesh
from service.asset.content.tangent import vertex_tangents
from service.asset.gltf.container import Glb

LARGEST_SHORT_COUNT = 65535
"""Vertices that indices of 16 bits can number: the largest index, 65535, is reserved for restarting a primitive (3.7.2.1)."""


def add_surface(glb: Glb, mesh: SurfaceMesh, *, unit_m: float, material: int, textured: bool, with_tangents: bool) -> Primitive:
    """Add the arrays of a mesh and return the primitive that uses them.

    Args:
        mesh: in the camera frame, which has the axes of glTF.
        unit_m: metres of a unit of the mesh; glTF has no other unit than the metre.
        material: number of the material.
        textured: write texture coordinates.
        with_tangents: write tangents, which only a normal map needs.

    Convention:
        The texture origin of glTF is the upper left corner, so v = 1 - t. The bitangent that a renderer makes, cross(normal, tangent) · w,
        must point to the upper edge of the image (3.7.2.1 and 3.9.3), which is N × T, so w = 1.
    """
    attributes = Attributes(POSITION=glb.add_array(mesh.points * np.float32(unit_m), target=ARRAY_BUFFER, bounds=True),
                            NORMAL=glb.add_array(mesh.normals, target=ARRAY_BUFFER))
    if textured:
        attributes.TEXCOORD_0 = glb.add_array(np.stack([mesh.st[:, 0], 1 - mesh.st[:, 1]], axis=-1), target=ARRAY_BUFFER)
    if with_tangents:
        tangents = np.ones((len(mesh.points), 4), dtype=np.float32)
        tangents[:, :3] = vertex_tangents(mesh)
        attributes.TANGENT = glb.add_array(tangents, target=ARRAY_BUFFER)
    indices = triangles_of(mesh)
    if len(mesh.points) <= LARGEST_SHORT_COUNT:
        indices = indices.astype(np.uint16)
    return Primitive(attributes=attributes, indices=glb.add_array(indices.ravel(), target=ELEMENT_ARRAY_BUFFER), mode=TRIANGLES,
                     material=material)


def add_points(glb: Glb, points: np.ndarray, colours: np.ndarray | None, *, material: int) -> Primitive:
    """Add points and return the primitive that uses them.

    Args:
        points: [n, 3] float32 metres, camera frame.
        colours: [n, 3] float32 scene-linear Rec.709, as COLOR_0 has them, clipped to 0…1; None: not known.
        material: number of the material.
    """
    attributes = Attributes(POSITION=glb.add_array(points, target=ARRAY_BUFFER, bounds=True))
    if colours is not None:
        attributes.COLOR_0 = glb.add_array(np.clip(colours, 0, 1), target=ARRAY_BUFFER)
    return Primitive(attributes=attributes, mode=POINTS, material=material)


def add_attribute(glb: Glb, primitive: Primitive, name: str, values: np.ndarray) -> None:
    """Add values [n] of the vertices or points of a primitive, which other programs do not know by themselves.

    Args:
        name: is written in capitals behind an underscore, as the specification asks (3.7.2.1).
        values: those that are not finite become 0.
    """
    finite = np.where(np.isfinite(values), values, 0).astype(np.float32)
    setattr(primitive.attributes, f"_{name.upper()}", glb.add_array(finite, target=ARRAY_BUFFER))


def triangles_of(mesh: SurfaceMesh) -> np.ndarray:
    """Return the faces as triangles, [2 Q + T, 3] uint32: quads are cut from their first corner, as renderers of USD cut them."""
    halves = mesh.quads[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)
    return np.concatenate([halves, mesh.triangles]).astype(np.uint32)
