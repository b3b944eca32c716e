"""The scene of a .glb: a root node that stands in the world, and below it what was captured, a mesh or points, and the camera.

Source: glTF 2.0 Specification, 3.5 "Scenes", 3.7.2 "Meshes" and 3.3 "Asset".
"""

import math
from collections.abc import Mapping

import numpy as np
import pygltflib as gltf
from pygltflib import ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER, POINTS, TRIANGLES, Asset, Attributes, Mesh, Node, Primitive, Scene

from service import __version__
from service.asset.content.camera import SCALE_NOTE, view_of
from service.asset.content.mesh import SurfaceMesh
from service.asset.content.tangent import vertex_tangents
from service.asset.gltf.container import Glb
from stage.capture.camera import Camera
from stage.results.result_metadata import result_metadata

GLTF_VERSION = "2.0"
FREE_OFFSET_PX = 0.5
"""Distance in pixels of the principal point from the image centre beyond which the camera is said to differ from the capturing one."""
LARGEST_SHORT_COUNT = 65535
"""Vertices that indices of 16 bits can number: the largest index, 65535, is reserved for restarting a primitive (3.7.2.1)."""


def add_surface(glb: Glb, mesh: SurfaceMesh, *, unit_m: float, material: int, textured: bool, with_tangents: bool) -> Primitive:
    """Add the arrays of a mesh and return the primitive that uses them.

    Args:
        unit_m: metres of a unit of the mesh; glTF has no other unit than the metre.
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
    """Add points [n, 3], metres, and return the primitive that uses them; colours are scene-linear Rec.709, and are clipped to 0…1."""
    attributes = Attributes(POSITION=glb.add_array(points, target=ARRAY_BUFFER, bounds=True))
    if colours is not None:
        attributes.COLOR_0 = glb.add_array(np.clip(colours, 0, 1), target=ARRAY_BUFFER)
    return Primitive(attributes=attributes, mode=POINTS, material=material)


def add_attribute(glb: Glb, primitive: Primitive, name: str, values: np.ndarray) -> None:
    """Add values [n] of the vertices or points of a primitive, which other programs do not know by themselves; not finite ones become 0.

    The name is written in capitals behind an underscore, as the specification asks (3.7.2.1).
    """
    finite = np.where(np.isfinite(values), values, 0).astype(np.float32)
    setattr(primitive.attributes, f"_{name.upper()}", glb.add_array(finite, target=ARRAY_BUFFER))


def triangles_of(mesh: SurfaceMesh) -> np.ndarray:
    """Return the faces as triangles, [2 Q + T, 3] uint32: quads are cut from their first corner, as renderers of USD cut them."""
    halves = mesh.quads[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)
    return np.concatenate([halves, mesh.triangles]).astype(np.uint32)


def camera_and_place(camera: Camera, extent: np.ndarray, *, unit_m: float) -> tuple[gltf.Camera, list[float]]:
    """Return the camera, and where it stands in the camera frame, in metres, before a surface in a box [2, 3] in units of the height map.

    Convention:
        A camera of glTF looks along -z with +y up, as the camera frame has it. An orthographic one is moved sideways by what its principal
        point is off the centre; a perspective one has no place for that (`principal_offset`), nor for lens distortion.
    """
    view = view_of(camera, extent)
    near, far = view.near * unit_m, view.far * unit_m
    if camera.projection == "perspective":
        assert camera.focal_px is not None  # the camera's validator saw to it
        half_width, half_height = camera.width / 2 / camera.focal_px[0], camera.height / 2 / camera.focal_px[1]
        lens = gltf.Perspective(yfov=2 * math.atan(half_height), aspectRatio=half_width / half_height, znear=near, zfar=far)
        return gltf.Camera(type="perspective", perspective=lens, name="Camera"), [0.0, 0.0, 0.0]
    pixel = (camera.pixel_size_m or 1.0) * unit_m
    box = gltf.Orthographic(xmag=camera.width * pixel / 2, ymag=camera.height * pixel / 2, znear=near, zfar=far)
    right, down = principal_offset(camera)
    return gltf.Camera(type="orthographic", orthographic=box, name="Camera"), [-right * pixel, down * pixel, view.z * unit_m]


def principal_offset(camera: Camera) -> tuple[float, float]:
    """Return how far the principal point lies to the right of the image centre and below it, in pixels."""
    cu, cv = camera.principal_point
    return cu - camera.width / 2, cv - camera.height / 2


def camera_warnings(camera: Camera) -> list[str]:
    """Return a sentence for what a camera of glTF cannot hold."""
    if camera.projection == "orthographic":
        return []
    right, down = principal_offset(camera)
    if max(abs(right), abs(down)) <= FREE_OFFSET_PX:
        return []
    return [f"camera: its principal point is {right:+.1f} px to the right of the image centre and {down:+.1f} px below it, which a "
            "camera of glTF cannot hold: it shows the asset shifted by as much; a .usdc keeps it"]


def add_scene(glb: Glb, primitive: Primitive, camera: Camera, extent: np.ndarray, provenance: Mapping[str, str], *, name: str,
              file_name: str, version: str, unit_m: float = 1.0) -> None:
    """Add the scene, and the metadata of the asset.

    Args:
        extent: [2, 3] bounding box of the primitive, camera frame, in units of the height map.
        provenance: kept in the extras of the root node, with the camera.
        file_name: of the asset, its identifier.
        unit_m: metres of a unit of the height map.

    Convention:
        The camera frame of Relit has the axes of glTF: +x right, +y up, +z towards the viewer. world_from_camera, where the capture gives
        it, is the matrix of the root node, column by column.
    """
    document = glb.document
    document.asset = Asset(version=GLTF_VERSION, generator=f"Relit {__version__}", extras={"identifier": file_name, "version": version})
    extras = result_metadata(camera, provenance)
    if unit_m != 1:
        extras["relit:scale"] = SCALE_NOTE
    root = Node(name=name, children=[1, 2], extras=dict(sorted(extras.items())))
    if camera.world_from_camera is not None and not np.array_equal(camera.world_from_camera, np.eye(4)):
        root.matrix = np.array(camera.world_from_camera, dtype=np.float64).T.ravel().tolist()
    lens, place = camera_and_place(camera, extent, unit_m=unit_m)
    document.cameras.append(lens)
    document.meshes.append(Mesh(name=name, primitives=[primitive]))
    kind = "Points" if primitive.mode == POINTS else "Mesh"
    document.nodes += [root, Node(name=kind, mesh=0), Node(name="Camera", camera=0, translation=place)]
    document.scenes.append(Scene(name=name, nodes=[0]))
    document.scene = 0
