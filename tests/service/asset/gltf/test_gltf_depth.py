"""Depths as .glb: a mesh with the photograph, or points with their colours."""

import numpy as np
import pytest

from service.asset.content.depth import depth_mesh
from service.asset.gltf.asset import write_depth
from service.errors import AssetError
from service.requests.export import Geometry, TextureFormat
from stage.capture.camera import Camera
from stage.results.depth_maps import DepthMaps
from tests.reference.colour import srgb_to_linear
from tests.service.asset import walls
from tests.service.asset.gltf.khronos import findings, validate
from tests.service.asset.gltf.reading import Read
from tests.service.asset.walls import cloud_of

POSE = ((0.0, 0.0, 1.0, 0.3), (1.0, 0.0, 0.0, -0.1), (0.0, 1.0, 0.0, 2.0), (0.0, 0.0, 0.0, 1.0))
CAMERA = Camera(projection="perspective", resolution=(24, 16), focal_px=(40.0, 40.0), world_from_camera=POSE)


def make(**layers):
    return walls.make(broken=True, camera=CAMERA, **layers)


def uncertain():
    layers = walls.uncertain()
    layers["sigma"][3, 3] = np.inf
    return layers


def test_khronos_validator_finds_nothing(tmp_path):
    files = []
    for geometry in Geometry:
        for number, (layers, known) in enumerate((({}, True), (uncertain(), True), (uncertain(), False))):
            maps = make(**layers)
            files.append(tmp_path / f"{geometry}{number}.glb")
            write_depth(maps, cloud_of(maps) if known else None, files[-1], name="壁", geometry=geometry)
    assert [findings(report) for report in validate(*files)] == [[]] * 6


def test_points_are_those_of_the_cloud(tmp_path):
    maps = make(**uncertain())
    cloud = cloud_of(maps)
    assert write_depth(maps, cloud, tmp_path / "a.glb", name="Wall", geometry=Geometry.POINTS) == ()
    read = Read(tmp_path / "a.glb")
    assert read.primitive.mode == 0 and read.primitive.indices is None
    np.testing.assert_array_equal(read.attribute("POSITION"), cloud.points)
    np.testing.assert_allclose(read.attribute("COLOR_0"), srgb_to_linear(cloud.colours / 255), atol=3e-5)  # the curve of OpenColorIO
    sigma = np.where(np.isfinite(maps.sigma), maps.sigma, 0)
    np.testing.assert_array_equal(read.attribute("_SIGMA"), sigma[maps.mask])
    np.testing.assert_array_equal(read.attribute("_CONFIDENCE"), maps.confidence[maps.mask])
    assert list(read.material.extensions) == ["KHR_materials_unlit"] == read.document.extensionsUsed
    root = read.document.nodes[0]
    np.testing.assert_array_equal(np.array(root.matrix).reshape(4, 4).T, POSE)
    assert root.extras["relit:capture"] == "wall" and "relit:scale" not in root.extras


def test_mesh_has_the_photograph_and_no_face_over_the_step(tmp_path):
    maps = make(**uncertain())
    cloud, mesh = cloud_of(maps), depth_mesh(maps)
    assert write_depth(maps, cloud, tmp_path / "a.glb", name="Wall") == ()
    read = Read(tmp_path / "a.glb")
    np.testing.assert_array_equal(read.attribute("POSITION"), mesh.points)
    corners = read.attribute("POSITION")[read.triangles()][..., 2]
    assert np.ptp(corners, axis=1).max() < 0.1  # the step is 0.8
    base, bits = read.image(read.material.pbrMetallicRoughness.baseColorTexture.index, tmp_path)
    assert bits == 8 and read.material.extensions == {"KHR_materials_specular": {"specularFactor": 0.0}}
    # linear and back: half a code, and float32
    np.testing.assert_allclose(base[maps.mask] * 255, cloud.colours, atol=0.51)
    sigma = np.where(np.isfinite(maps.sigma), maps.sigma, 0)
    np.testing.assert_array_equal(read.attribute("_SIGMA"), sigma[mesh.rows, mesh.cols])


@pytest.mark.parametrize("geometry", list(Geometry))
def test_without_a_cloud_it_is_grey_and_said(geometry, tmp_path):
    warnings = write_depth(make(), None, tmp_path / "a.glb", name="Wall", geometry=geometry)
    assert len(warnings) == 1 and "the asset is grey" in warnings[0]
    read = Read(tmp_path / "a.glb")
    assert read.material.pbrMetallicRoughness.baseColorFactor == [0.18, 0.18, 0.18, 1] and not read.document.images


def test_what_cannot_become_a_glb_leaves_nothing(tmp_path):
    with pytest.raises(AssetError, match=r"a \.glb takes PNG"):
        write_depth(make(), None, tmp_path / "a.glb", name="Wall", textures=TextureFormat.EXR)
    empty = DepthMaps(camera=CAMERA, mask=np.zeros((16, 24), bool), depth=np.zeros((16, 24), np.float32))
    for geometry in Geometry:
        with pytest.raises(AssetError, match="nothing to export"):
            write_depth(empty, None, tmp_path / "a.glb", name="Wall", geometry=geometry)
    assert list(tmp_path.iterdir()) == []
