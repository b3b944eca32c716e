"""relit inspect of a .glb: its facts, and what damaged files are called."""

import dataclasses
import json
import struct

import numpy as np
import pytest

from service.asset.errors import AssetError
from service.asset.mesh import height_mesh
from service.cli.main import main
from service.gltf.asset import write_asset
from service.gltf.depth_asset import write_depth
from service.gltf.inspect import inspect_glb
from service.requests.export import Geometry
from stage.camera import Camera
from stage.depth_maps import DepthMaps
from tests.scenes.surfaces import make_ball

POSE = ((0.0, 0.0, 1.0, 0.3), (1.0, 0.0, 0.0, -0.1), (0.0, 1.0, 0.0, 2.0), (0.0, 0.0, 0.0, 1.0))


def written(tmp_path, **changes):
    ball = make_ball(specular=np.full((24, 24, 3), 0.08, np.float32), **changes)
    return write_asset(ball, tmp_path / "ball.glb", name="Eule – 梟", version="v003").path


def rewritten(path, change):
    """The same file after a change of its document."""
    data = path.read_bytes()
    length = struct.unpack_from("<I", data, 12)[0]
    document = json.loads(data[20:20 + length])
    change(document)
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    rest = data[20 + length:]
    path.write_bytes(struct.pack("<4sIII4s", b"glTF", 2, 20 + len(text) + len(rest), len(text), b"JSON") + text + rest)
    return path


def test_facts(tmp_path):
    ball = make_ball()
    path = written(tmp_path, camera=ball.camera.model_copy(update={"world_from_camera": POSE}))
    found, mesh = inspect_glb(path), height_mesh(ball)
    assert found.size_bytes == path.stat().st_size and found.errors == ()
    assert found.asset_info["identifier"] == "ball.glb" and found.asset_info["version"] == "v003" and found.asset_info["glTF"] == "2.0"
    assert found.extensions == ("KHR_materials_ior",)
    (primitive,) = found.primitives
    assert (primitive.mesh, primitive.mode, primitive.vertices) == ("Eule – 梟", "triangles", len(mesh.points))
    assert primitive.faces == 2 * len(mesh.quads) + len(mesh.triangles) and primitive.material == "Eule – 梟"
    assert set(primitive.attributes) == {"POSITION", "NORMAL", "TANGENT", "TEXCOORD_0"}
    world = mesh.points @ np.array(POSE)[:3, :3].T + np.array(POSE)[:3, 3]
    np.testing.assert_allclose(found.extent_m, [world.min(axis=0), world.max(axis=0)], atol=1e-6)  # float32 positions
    (look,) = found.materials
    assert {name: (image.width, image.height, image.channels, image.depth) for name, image in look.images.items()} == {
        "baseColorTexture": (24, 24, 3, 8), "metallicRoughnessTexture": (24, 24, 3, 16), "normalTexture": (24, 24, 3, 16)}
    assert look.values["doubleSided"] is True and look.values["KHR_materials_ior.ior"] > 1.5
    assert found.cameras == ("Camera, orthographic, 0.2 × 0.2 m",)
    assert found.provenance["relit:method"] == "svbrdf"


def test_points(tmp_path):
    camera = Camera(projection="perspective", resolution=(4, 4), focal_px=(4.0, 4.0))
    depth = DepthMaps(camera=camera, mask=np.ones((4, 4), bool), depth=np.ones((4, 4), np.float32))
    write_depth(depth, None, tmp_path / "a.glb", name="A", geometry=Geometry.POINTS)
    found = inspect_glb(tmp_path / "a.glb")
    assert [(each.mode, each.vertices, each.faces) for each in found.primitives] == [("points", 16, 0)]
    assert found.materials[0].values["KHR_materials_unlit"] is True and found.materials[0].images == {}
    assert found.cameras == (f"Camera, perspective, {2 * np.degrees(np.arctan(0.5)):.4g}° high",)


def test_transforms_of_other_programs_are_followed(tmp_path):
    """Half a turn about z, twice the size, one metre to the right."""
    def place(document):
        document["nodes"][1] |= {"rotation": [0, 0, 1, 0], "scale": [2, 2, 2], "translation": [1, 0, 0]}

    points = height_mesh(make_ball()).points
    turned = points * [-2, -2, 2] + [1, 0, 0]
    found = inspect_glb(rewritten(written(tmp_path), place))
    np.testing.assert_allclose(found.extent_m, [turned.min(axis=0), turned.max(axis=0)], atol=1e-6)


@pytest.mark.parametrize("change, sentence", [
    (lambda document: document["accessors"][0].update(count=10**6), "accessor 0 reaches beyond its bufferView"),
    (lambda document: document["bufferViews"][2].update(byteLength=10**8), "bufferView 2 reaches beyond")])
def test_data_beyond_its_buffer_is_an_error(change, sentence, tmp_path):
    assert any(sentence in error for error in inspect_glb(rewritten(written(tmp_path), change)).errors)


@pytest.mark.parametrize("change", [
    lambda document: document["nodes"][0].update(children=[7]), lambda document: document["meshes"][0]["primitives"][0].update(material=3),
    lambda document: document["accessors"][0].update(componentType=99),
    lambda document: document["nodes"][1].update(mesh=5),
    lambda document: document["nodes"][1].update(children=[0])])
def test_a_document_that_refers_to_nothing_is_refused(change, tmp_path):
    path = rewritten(written(tmp_path), change)
    with pytest.raises(AssetError, match="is damaged") as raised:
        inspect_glb(path)
    assert str(path) in str(raised.value)


def test_the_command_prints_facts_and_json(tmp_path, capsys, monkeypatch):
    path = written(tmp_path)
    monkeypatch.setattr("sys.argv", ["relit", "inspect", str(path)])
    assert run(main) == 0
    printed = capsys.readouterr().out
    assert " metallicRoughnessTexture: metallic_roughness, 24×24, 3 × 16" in printed and "KHR_materials_ior" in printed
    monkeypatch.setattr("sys.argv", ["relit", "inspect", "--json", str(path)])
    assert run(main) == 0
    assert json.loads(capsys.readouterr().out) == json.loads(json.dumps(dataclasses.asdict(inspect_glb(path))))


def run(program):
    """The exit code of a program."""
    try:
        program()
    except SystemExit as end:
        return end.code or 0
    return 0
