"""relit export --out *.glb."""

import numpy as np
import pytest

from service.asset.gltf.container import read_glb
from service.errors import AssetError
from service.export.export import export
from service.requests.export import ExportRequest, Geometry
from stage.capture.camera import Camera
from stage.results.depth_maps import DepthMaps
from tests.scenes.surfaces import make_ball, make_wave


def test_solved_maps_become_a_glb(tmp_path):
    make_ball(provenance={"relit:capture": "ball 1"}).write(tmp_path / "maps.exr")
    exported = export(ExportRequest(maps=tmp_path, out=tmp_path / "out" / "Ball.GLB"))
    assert exported.path == tmp_path / "out" / "Ball.GLB" and exported.warnings == ()
    document = read_glb(exported.path).document
    assert document.nodes[0].name == "ball 1" and len(document.images) == 3


def test_warnings_of_clipping_and_of_the_camera_are_given(tmp_path):
    green = np.broadcast_to(np.float32([0, 1, 0]), (20, 30, 3))
    maps = make_wave("perspective")
    type(maps)(**{**vars(maps), "diffuse_albedo": green, "color_space": "lin_ap1_scene"}).write(tmp_path / "maps.exr")
    warnings = export(ExportRequest(maps=tmp_path, out=tmp_path / "a.glb")).warnings
    assert len(warnings) == 2 and "principal point" in warnings[0] and warnings[1].startswith("base_color: 600 pixels")


@pytest.mark.parametrize("geometry, mode", [(None, 4), (Geometry.POINTS, 0)])
def test_a_depth_becomes_a_glb(geometry, mode, tmp_path):
    camera = Camera(projection="perspective", resolution=(4, 4), focal_px=(4.0, 4.0), principal_px=(2.0, 2.0))
    DepthMaps(camera=camera, mask=np.ones((4, 4), bool), depth=np.ones((4, 4), np.float32)).write(tmp_path / "depth.exr")
    exported = export(ExportRequest(maps=tmp_path, out=tmp_path / "a.glb", geometry=geometry))
    assert len(exported.warnings) == 1 and "grey" in exported.warnings[0]
    assert read_glb(exported.path).document.meshes[0].primitives[0].mode == mode


def test_an_unknown_suffix_names_the_known(tmp_path):
    make_ball().write(tmp_path / "maps.exr")
    with pytest.raises(AssetError, match=r"\.usda, \.usdc or \.usdz for USD, or \.glb for glTF"):
        export(ExportRequest(maps=tmp_path, out=tmp_path / "a.gltf"))
    assert [path.name for path in tmp_path.iterdir()] == ["maps.exr"]
