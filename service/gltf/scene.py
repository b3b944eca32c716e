"""The scene of a .glb: a root node that stands in the world, and below it what was captured and the camera.

Source: glTF 2.0 Specification, 3.5 "Scenes" and 3.3 "Asset".
"""

from collections.abc import Mapping

import numpy as np
from pygltflib import POINTS, Asset, Mesh, Node, Primitive, Scene

from service import __version__
from service.asset.units import SCALE_NOTE
from service.gltf.camera import camera_and_place
from service.gltf.container import Glb
from stage.camera import Camera
from stage.result_metadata import result_metadata

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
