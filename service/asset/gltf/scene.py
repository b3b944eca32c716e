"""The scene of a .glb: a root node that stands in the world, and below it what was captured and the camera.

Source: glTF 2.0 Specification, 3.5 "Scenes" and 3.3 "Asset".
"""

import math
from collections.abc import Mapping

import numpy as np
import pygltflib as gltf
from pygltflib import POINTS, Asset, Mesh, Node, Primitive, Scene

from service import __version__
from service.asset.content.camera import SCALE_NOTE, view_of
from service.asset.gltf.container import Glb
from stage.capture.camera import Camera
from stage.results.result_metadata import result_metadata

FREE_OFFSET_PX = 0.5
"""Distance in pixels of the principal point from the image centre beyond which the camera is said to differ from the capturing one."""


def camera_and_place(camera: Camera, extent: np.ndarray, *, unit_m: float) -> tuple[gltf.Camera, list[float]]:
    """Return the camera, and where it stands in the camera frame, in metres.

    Args:
        extent: [2, 3] bounding box of the surface, camera frame, in units of the height map.
        unit_m: metres of such a unit.

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


GLTF_VERSION = "2.0"


def add_scene(glb: Glb, primitive: Primitive, camera: Camera, extent: np.ndarray, provenance: Mapping[str, str], *, name: str,
              file_name: str, version: str, unit_m: float = 1.0) -> None:
    """Add the scene, and the metadata of the asset.

    Args:
        primitive: what was captured.
        extent: [2, 3] its bounding box, camera frame, in units of the height map.
        provenance: kept in the extras of the root node, with the camera.
        name: of the root node and the mesh.
        file_name: of the asset, its identifier.
        version: of the asset.
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
