"""Solved maps and depths as binary glTF."""

import dataclasses

import numpy as np
import pytest

from service.asset.content.depth import depth_mesh
from service.asset.content.mesh import height_mesh
from service.asset.content.metallic import metallic_look
from service.asset.gltf.asset import write_asset, write_depth
from service.asset.gltf.container import read_glb
from service.errors import AssetError
from service.requests.export import Geometry, TextureFormat
from stage.capture.camera import Camera
from stage.results.depth_maps import DepthMaps
from tests.reference.colour import srgb_to_linear
from tests.scenes.surfaces import make_ball, make_wave
from tests.service.asset import walls
from tests.service.asset.gltf.reading import Read, findings, validate
from tests.service.asset.gltf.surfaces import POSE, SURFACES, metal_and_paint, random_surface
from tests.service.asset.walls import cloud_of

DEPTH_POSE = ((0.0, 0.0, 1.0, 0.3), (1.0, 0.0, 0.0, -0.1), (0.0, 1.0, 0.0, 2.0), (0.0, 0.0, 0.0, 1.0))
CAMERA = Camera(projection="perspective", resolution=(24, 16), focal_px=(40.0, 40.0), world_from_camera=DEPTH_POSE)


def test_khronos_validator_finds_nothing(tmp_path):
    files = [write_asset(maps, tmp_path / f"{number}.glb", name=f"Eule – 梟 {name}").path
             for number, (name, maps) in enumerate(SURFACES.items())]
    reports = validate(*files)
    assert {name: findings(report) for name, report in zip(SURFACES, reports, strict=True)} == {name: [] for name in SURFACES}
    for maps, report in zip(SURFACES.values(), reports, strict=True):
        assert report["info"]["totalVertexCount"] == len(height_mesh(maps).points)


def test_khronos_validator_finds_nothing_in_noise(tmp_path):
    rng, files = np.random.default_rng(0), []
    for number in range(40):
        try:
            files.append(write_asset(random_surface(rng), tmp_path / f"{number}.glb", name="Noise").path)
        except AssetError as error:
            assert "no face" in str(error)  # in a small mask with holes
    assert len(files) > 20
    assert [findings(report) for report in validate(*files)] == [[]] * len(files)


@pytest.mark.parametrize("maps", SURFACES.values(), ids=SURFACES)
def test_geometry_is_that_of_the_mesh(maps, tmp_path):
    report = write_asset(maps, tmp_path / "a.glb", name="A")
    mesh, read = height_mesh(maps), Read(report.path)
    metres = np.float32(1 if maps.camera.metric else 0.001)
    positions = read.attribute("POSITION")
    np.testing.assert_array_equal(positions, mesh.points * metres)
    accessor = read.document.accessors[read.primitive.attributes.POSITION]
    assert np.array_equal(np.float32(accessor.min), positions.min(axis=0)) and accessor.min == positions.min(axis=0).tolist()
    assert accessor.max == positions.max(axis=0).tolist()
    normals = read.attribute("NORMAL").astype(np.float64)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-6)  # float32 rounding
    triangles = read.triangles()
    assert triangles.dtype == (np.uint16 if len(positions) <= 65535 else np.uint32)
    assert report.sizes["mesh"][1] == len(triangles) == 2 * len(mesh.quads) + len(mesh.triangles)
    assert sorted(set(triangles.ravel().tolist())) == list(range(len(positions)))
    a, b, c = (positions[triangles[:, corner]].astype(np.float64) for corner in range(3))
    facing = np.einsum("tx,tx->t", np.cross(b - a, c - a), -a if maps.camera.projection == "perspective" else np.array([[0, 0, 1.0]]))
    assert (facing > 0).all()  # counter-clockwise for the camera, which is the front of glTF
    assert read.material.doubleSided and read.material.alphaMode == "OPAQUE"


def test_texture_coordinates_and_tangents(tmp_path):
    maps = make_ball(48)
    read, mesh = Read(write_asset(maps, tmp_path / "a.glb", name="A").path), height_mesh(maps)
    uv = read.attribute("TEXCOORD_0")
    # the centre of each pixel, from the upper left corner, then the border; float32 rounding of values below 1, twice
    np.testing.assert_allclose(uv[:mesh.centred], (np.stack([mesh.cols, mesh.rows], axis=-1) + 0.5)[:mesh.centred] / 48, atol=1.2e-7)
    np.testing.assert_allclose(uv, np.stack([mesh.st[:, 0], 1 - mesh.st[:, 1]], axis=-1), atol=1.2e-7)
    tangent, normal = read.attribute("TANGENT").astype(np.float64), read.attribute("NORMAL").astype(np.float64)
    assert (tangent[:, 3] == 1).all()
    np.testing.assert_allclose(np.linalg.norm(tangent[:, :3], axis=1), 1, atol=1e-6)
    np.testing.assert_allclose(np.einsum("vx,vx->v", tangent[:, :3], normal), 0, atol=1e-6)
    triangles, positions = read.triangles(), read.attribute("POSITION").astype(np.float64)
    a, b, c = triangles.T
    edges = np.stack([positions[b] - positions[a], positions[c] - positions[a]], axis=1)
    steps = np.stack([uv[b] - uv[a], uv[c] - uv[a]], axis=1).astype(np.float64)
    slopes = np.linalg.solve(steps, edges)  # [triangles, (∂P/∂u, ∂P/∂v), xyz]
    bitangent = np.cross(normal, tangent[:, :3]) * tangent[:, 3:]
    assert (np.einsum("tx,tx->t", slopes[:, 0], tangent[a, :3]) > 0).all()
    assert (np.einsum("tx,tx->t", slopes[:, 1], bitangent[a]) < 0).all()  # up in the image, where green of a normal map points


def test_normal_map_gives_the_solved_normals_back(tmp_path):
    """As a renderer reads it: tangent, cross(normal, tangent) · w and normal, times the decoded texel."""
    rng = np.random.default_rng(5)
    normal = rng.normal(size=(24, 24, 3)) * 0.3 + [0, 0, 1]
    maps = make_ball(normal=(normal / np.linalg.norm(normal, axis=-1, keepdims=True)).astype(np.float32))
    read, mesh = Read(write_asset(maps, tmp_path / "a.glb", name="A").path), height_mesh(maps)
    codes, bits = read.image(read.material.normalTexture.index, tmp_path)
    assert bits == 16 and read.material.normalTexture.scale == 1
    x, y, z = (codes[mesh.rows, mesh.cols] * 2 - 1).T[..., None]
    t, n = read.attribute("TANGENT").astype(np.float64), read.attribute("NORMAL").astype(np.float64)
    shaded = x * t[:, :3] + y * np.cross(n, t[:, :3]) * t[:, 3:] + z * n
    # half a code of 16 bits is 1.5e-5 after the factor 2; the frame is float32; three components add up
    on_pixels = slice(mesh.centred)
    np.testing.assert_allclose(shaded[on_pixels], maps.normal[mesh.rows[on_pixels], mesh.cols[on_pixels]], atol=5e-5)


def test_material_is_the_metallic_look(tmp_path):
    maps = metal_and_paint(roughness=np.linspace(0.1, 0.9, 32 * 32, dtype=np.float32).reshape(32, 32))
    read, look = Read(write_asset(maps, tmp_path / "a.glb", name="A").path), metallic_look(maps)
    surface = read.material.pbrMetallicRoughness
    assert (surface.metallicFactor, surface.roughnessFactor, surface.baseColorFactor) == (1, 1, [1, 1, 1, 1])
    base, bits = read.image(surface.baseColorTexture.index, tmp_path)
    assert bits == 8  # as the specification asks
    # half a code of 8 bits, times the steepest slope of the sRGB curve, 2.28
    np.testing.assert_allclose(srgb_to_linear(base)[maps.mask], look.base_color[maps.mask], atol=0.5 / 255 * 2.28)
    packed, bits = read.image(surface.metallicRoughnessTexture.index, tmp_path)
    assert bits == 16
    np.testing.assert_allclose(packed[maps.mask][:, 1], maps.roughness[maps.mask], atol=0.5 / 65535 + 1e-7)  # half a code
    np.testing.assert_allclose(packed[maps.mask][:, 2], look.metallic[maps.mask], atol=0.5 / 65535 + 1e-7)
    brass = maps.mask & (maps.normal[..., 0] > 0)
    assert (packed[brass][:, 2] > 0.999).all() and (packed[maps.mask & ~brass][:, 2] < 0.01).all()
    np.testing.assert_allclose(srgb_to_linear(base[brass]), np.broadcast_to([0.9, 0.7, 0.4], (brass.sum(), 3)), atol=0.5 / 255 * 2.28)
    sampler = read.document.samplers[0]
    assert (sampler.wrapS, sampler.wrapT, sampler.magFilter, sampler.minFilter) == (33071, 33071, 9729, 9987)


def test_eight_bits_on_request(tmp_path):
    maps = metal_and_paint()
    large, small = (write_asset(maps, tmp_path / f"{kind}.glb", name="A", textures=kind).path
                    for kind in (TextureFormat.PNG16, TextureFormat.PNG8))
    assert small.stat().st_size < large.stat().st_size
    read = Read(small)
    for texture in range(3):
        assert read.image(texture, tmp_path)[1] == 8
    packed, _ = read.image(read.material.pbrMetallicRoughness.metallicRoughnessTexture.index, tmp_path)
    np.testing.assert_allclose(packed[maps.mask][:, 1], 0.35, atol=0.5 / 255 + 1e-6)  # half a code


def test_exr_textures_are_refused(tmp_path):
    with pytest.raises(AssetError, match=r"a \.glb takes PNG"):
        write_asset(SURFACES["everything"], tmp_path / "a.glb", name="A", textures=TextureFormat.EXR)
    assert list(tmp_path.iterdir()) == []


def test_index_of_refraction_is_written_where_it_is_not_the_default(tmp_path):
    glass = Read(write_asset(SURFACES["everything"], tmp_path / "a.glb", name="A").path)
    assert not glass.material.extensions and not glass.document.extensionsUsed
    other = Read(write_asset(SURFACES["other dielectric"], tmp_path / "b.glb", name="B").path)
    ior = other.material.extensions["KHR_materials_ior"]["ior"]
    assert ((ior - 1) / (ior + 1)) ** 2 == pytest.approx(0.08, rel=1e-5)  # F0 is float32
    assert other.document.extensionsUsed == ["KHR_materials_ior"] and not other.document.extensionsRequired


def test_without_specular_it_renders_as_the_fitted_lambertian(tmp_path):
    read = Read(write_asset(SURFACES["diffuse only"], tmp_path / "a.glb", name="A").path)
    surface = read.material.pbrMetallicRoughness
    assert read.material.extensions == {"KHR_materials_specular": {"specularFactor": 0.0}}
    assert surface.metallicFactor == 0 and surface.roughnessFactor == 1 and surface.metallicRoughnessTexture is None
    grey = Read(write_asset(SURFACES["no scale"], tmp_path / "b.glb", name="B").path)
    assert grey.material.pbrMetallicRoughness.baseColorFactor == [0.18, 0.18, 0.18, 1] and not grey.document.images
    assert grey.primitive.attributes.TEXCOORD_0 is None and grey.primitive.attributes.TANGENT is None


@pytest.mark.parametrize("maps", [
    make_wave("orthographic", pixel_size_m=0.004, world_from_camera=POSE), make_wave("orthographic"),
    make_wave("perspective", principal_px=(15.0, 10.0), world_from_camera=POSE), make_wave("perspective", principal_px=(15.0, 10.0))],
    ids=["orthographic, off centre", "no scale", "perspective", "perspective, no pose"])
def test_camera_sees_each_vertex_at_its_pixel(maps, tmp_path):
    """With the projection matrices of section 3.10.3, and the nodes' transforms."""
    report = write_asset(maps, tmp_path / "a.glb", name="A")
    mesh, read = height_mesh(maps), Read(report.path)
    numbers = {node.name: number for number, node in enumerate(read.document.nodes)}
    points = np.column_stack([read.attribute("POSITION").astype(np.float64), np.ones(len(mesh.points))])
    seen = np.linalg.inv(read.world_from_node(numbers["Camera"])) @ read.world_from_node(numbers["Mesh"]) @ points.T
    camera = read.document.cameras[read.document.nodes[numbers["Camera"]].camera]
    if camera.type == "orthographic":
        lens = camera.orthographic
        x, y = seen[0] / lens.xmag, seen[1] / lens.ymag
    else:
        lens = camera.perspective
        x, y = (seen[axis] / -seen[2] / np.tan(lens.yfov / 2) for axis in (0, 1))
        x = x / lens.aspectRatio
    np.testing.assert_allclose((x + 1) / 2 * 30, mesh.st[:, 0] * 30, atol=1e-4)  # float32 positions
    np.testing.assert_allclose((1 - y) / 2 * 20, (1 - mesh.st[:, 1]) * 20, atol=1e-4)
    assert (-seen[2] > lens.znear).all() and (-seen[2] < lens.zfar).all()
    assert report.warnings == ()


def test_pose_names_and_provenance(tmp_path):
    maps = dataclasses.replace(SURFACES["everything"], camera=SURFACES["everything"].camera.model_copy(update={"world_from_camera": POSE}))
    document = read_glb(write_asset(maps, tmp_path / "a.glb", name="Eule – 梟", version="v003").path).document
    root = document.nodes[document.scenes[document.scene].nodes[0]]
    np.testing.assert_array_equal(np.array(root.matrix).reshape(4, 4).T, POSE)
    assert {root.name, document.meshes[0].name, document.materials[0].name} == {"Eule – 梟"}
    assert root.extras["relit:method"] == "svbrdf" and root.extras["relit:camera"] == maps.camera.model_dump_json()
    assert document.asset.version == "2.0" and document.asset.generator.startswith("Relit")
    assert document.asset.extras == {"identifier": "a.glb", "version": "v003"}
    assert "relit:scale" not in root.extras
    unknown = read_glb(write_asset(SURFACES["no scale"], tmp_path / "b.glb", name="B").path).document
    assert unknown.nodes[0].extras["relit:scale"].startswith("unknown") and unknown.nodes[0].matrix is None


def make(**layers):
    return walls.make(broken=True, camera=CAMERA, **layers)


def uncertain():
    layers = walls.uncertain()
    layers["sigma"][3, 3] = np.inf
    return layers


def test_khronos_validator_finds_nothing_in_a_depth(tmp_path):
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
    np.testing.assert_array_equal(np.array(root.matrix).reshape(4, 4).T, DEPTH_POSE)
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
