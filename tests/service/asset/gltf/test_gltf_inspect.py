"""What relit inspect says of a .glb, and its file complete or absent."""

import dataclasses
import json
import re
import struct
from base64 import b64encode

import numpy as np
import pytest

from service.asset.content.mesh import height_mesh
from service.asset.gltf import container
from service.asset.gltf.asset import write_asset, write_depth
from service.asset.gltf.container import read_glb
from service.asset.gltf.inspect import inspect_glb
from service.errors import AssetError
from service.export.export import export
from service.requests.export import ExportRequest, Geometry
from stage.capture.camera import Camera
from stage.errors import StorageError
from stage.results.depth_maps import DepthMaps
from tests.scenes.surfaces import make_ball, make_wave
from tests.service.asset.gltf.surfaces import SURFACES
from tests.service.full_disk import files_of_at_most


def written(tmp_path, **changes):
    ball = make_ball(specular=np.full((24, 24, 3), 0.08, np.float32), **changes)
    return write_asset(ball, tmp_path / "ball.glb", name="Eule – 梟", version="v003").path


def chunks(path):
    """The document of a file, and what follows it."""
    data = path.read_bytes()
    length = struct.unpack_from("<I", data, 12)[0]
    return json.loads(data[20:20 + length]), data[20 + length:]


def with_document(path, text, rest=b""):
    text += b" " * (-len(text) % 4)
    path.write_bytes(struct.pack("<4sIII4s", b"glTF", 2, 20 + len(text) + len(rest), len(text), b"JSON") + text + rest)
    return path


def rewritten(path, change):
    """The same file after a change of its document."""
    document, rest = chunks(path)
    change(document)
    return with_document(path, json.dumps(document).encode(), rest)


def overwritten(path, view, raw):
    """The same file with other bytes at the beginning of a view into its buffer, which its document chooses."""
    document, rest = chunks(path)
    at = 8 + view(document).get("byteOffset", 0)
    return with_document(path, json.dumps(document).encode(), rest[:at] + raw + rest[at + len(raw):])


def view_of(name):
    """A choice for `overwritten`: the view of an attribute, of the indices or of the first image."""
    def choose(document):
        primitive = document["meshes"][0]["primitives"][0]
        if name == "image":
            return document["bufferViews"][document["images"][0]["bufferView"]]
        accessor = document["accessors"][primitive["indices"] if name == "indices" else primitive["attributes"][name]]
        return document["bufferViews"][accessor["bufferView"]]
    return choose


def test_facts(tmp_path):
    path, mesh = written(tmp_path), height_mesh(make_ball())
    found = inspect_glb(path)
    assert found.size_bytes == path.stat().st_size and (found.errors, found.warnings) == ((), ())
    info = found.facts["asset_info"]
    assert (info["identifier"], info["version"], info["glTF"]) == ("ball.glb", "v003", "2.0")
    assert found.facts["extensions"] == ["KHR_materials_ior"] and found.provenance["relit:method"] == "svbrdf"
    surface, material, *textures, camera = found.parts
    assert surface[:2] == ("mesh", "Eule – 梟") and surface.facts["vertices"] == len(mesh.points)
    assert surface.facts["faces"] == 2 * len(mesh.quads) + len(mesh.triangles) and surface.facts["material"] == "Eule – 梟"
    assert set(surface.facts["attributes"]) == {"POSITION", "NORMAL", "TANGENT", "TEXCOORD_0"}
    np.testing.assert_allclose([surface.facts["low"], surface.facts["high"]], mesh.extent, atol=1e-6)
    assert {part.name.split()[-1]: (part.facts["resolution"], part.facts["channels"], part.facts["depth"]) for part in textures} == {
        "baseColorTexture": ([24, 24], 3, "uint8"), "metallicRoughnessTexture": ([24, 24], 3, "uint16"),
        "normalTexture": ([24, 24], 3, "uint16")}
    assert material.facts["doubleSided"] is True and material.facts["KHR_materials_ior.ior"] > 1.5
    assert camera.facts == {"orthographic_m": pytest.approx([0.2, 0.2], rel=0.05)}


def test_points(tmp_path):
    camera = Camera(projection="perspective", resolution=(4, 4), focal_px=(4.0, 4.0))
    depth = DepthMaps(camera=camera, mask=np.ones((4, 4), bool), depth=np.ones((4, 4), np.float32))
    write_depth(depth, None, tmp_path / "a.glb", name="A", geometry=Geometry.POINTS)
    points, material, lens = inspect_glb(tmp_path / "a.glb").parts
    assert points.kind == "points" and points.facts["vertices"] == 16 and "faces" not in points.facts
    assert material.facts["KHR_materials_unlit"] is True
    assert lens.facts["degrees_high"] == pytest.approx(2 * np.degrees(np.arctan(0.5)))


@pytest.mark.parametrize("change, sentence", [
    (lambda document: document["accessors"][0].update(count=10**6), "accessor 0 reaches beyond its bufferView"),
    (lambda document: document["bufferViews"][2].update(byteLength=10**8), "bufferView 2 reaches beyond"),
    (lambda document: document["nodes"][0].update(children=[7]), "node 7"),
    (lambda document: document["nodes"][1].update(mesh=5), "mesh 5"),
    (lambda document: document["nodes"][1].update(children=[0]), "no tree"),
    (lambda document: document["buffers"][0].update(uri="none.bin"), "none.bin is not there")])
def test_references_beyond_the_file_are_errors(change, sentence, tmp_path):
    assert any(sentence in error for error in inspect_glb(rewritten(written(tmp_path), change)).errors)


@pytest.mark.parametrize("change", [lambda document: document["meshes"][0]["primitives"][0].update(material=3),
                                    lambda document: document["accessors"][0].update(componentType=99)])
def test_a_document_that_refers_to_nothing_is_refused(change, tmp_path):
    path = rewritten(written(tmp_path), change)
    with pytest.raises(AssetError, match="is damaged") as raised:
        inspect_glb(path)
    assert str(path) in str(raised.value)


def test_a_file_outside_is_a_warning(tmp_path):
    (tmp_path / "a b.bin").write_bytes(bytes(100))
    path = rewritten(written(tmp_path), lambda document: document["buffers"].append({"uri": "a%20b.bin", "byteLength": 100}))
    found = inspect_glb(path)
    assert found.errors == () and "a b.bin, which lies outside of it" in found.warnings[0]
    assert found.size_bytes == path.stat().st_size + 100


def test_images_of_another_type_than_declared_are_errors(tmp_path):
    """Viewers decode by the type that is declared; relit inspect reads the image as what it is."""
    path = rewritten(written(tmp_path), lambda document: document["images"][0].update(mimeType="image/jpeg"))
    found = inspect_glb(path)
    assert found.warnings == () and len(found.errors) == len({part.name for part in found.parts if "declared" in part.facts}) > 0
    assert all("is declared as jpeg, and is png: correct its mimeType" in error for error in found.errors)
    assert any(part.facts.get("resolution") for part in found.parts if "declared" in part.facts)


@pytest.mark.parametrize(("pixel_m", "said"), [(1e-3, False), (10.0, True), (1e-6, True)])
def test_sizes_of_another_unit_are_asked_about(tmp_path, pixel_m, said):
    ball = make_ball()
    camera = ball.camera.model_copy(update={"pixel_size_m": pixel_m})
    scaled = dataclasses.replace(ball, camera=camera, height=ball.height * (pixel_m / ball.camera.pixel_size_m))
    path = write_asset(scaled, tmp_path / "a.glb", name="a").path
    assert any("m large: glTF is in metres" in words for words in inspect_glb(path).warnings) == said


@pytest.mark.parametrize(("place", "value", "words"), [
    (8, 10**4, "the header says that the file has 10000 bytes"), ("chunk", 10**9, "1000000000 bytes"), ("kind", b"ZIP\0", "ZIP")])
def test_false_lengths_are_errors(place, value, words, tmp_path):
    path = written(tmp_path)
    data = bytearray(path.read_bytes())
    chunk = 20 + struct.unpack_from("<I", data, 12)[0]
    begin = {"chunk": chunk, "kind": chunk + 4}.get(place, place)
    data[begin:begin + 4] = value if isinstance(value, bytes) else struct.pack("<I", value)
    path.write_bytes(data)
    assert any(words in error for error in inspect_glb(path).errors)


def test_brackets_without_end_are_one_sentence(relit, tmp_path):
    path = with_document(tmp_path / "deep.glb", b"[" * 500_000)
    outcome = relit("inspect", path)
    assert (outcome.code, outcome.out) == (2, "") and "deep.glb" in outcome.err and outcome.err.count("\n") == 1


def test_the_command_prints_facts_and_json(relit, tmp_path):
    path = written(tmp_path)
    printed = relit("inspect", path).out
    assert "metallicRoughnessTexture: file metallic_roughness, bytes" in printed
    assert "resolution (24, 24), channels 3, depth uint16" in printed
    outcome = relit("inspect", "--json", path)
    assert outcome.code == 0 and json.loads(outcome.out)["parts"] == [part._asdict() for part in inspect_glb(path).parts]


def test_the_same_maps_give_the_same_bytes(tmp_path):
    one, two = (write_asset(SURFACES["everything"], tmp_path / folder / "a.glb", name="A").path.read_bytes() for folder in ("1", "2"))
    assert one == two


@pytest.mark.parametrize("older", [False, True], ids=["nothing before", "older asset"])
@pytest.mark.parametrize("refused", ["a texture", "the end of the file"])
def test_a_disk_that_really_refuses(refused, older, tmp_path):
    whole = write_asset(SURFACES["everything"], tmp_path / "whole.glb", name="A").path
    target = tmp_path / "out" / "a.glb"
    if older:
        write_asset(SURFACES["diffuse only"], target, name="A")
    before = {path: path.read_bytes() for path in target.parent.glob("*")}
    limit = 100 if refused == "a texture" else whole.stat().st_size - 100
    with files_of_at_most(limit), pytest.raises(StorageError, match=f"cannot write {target}: "):
        write_asset(SURFACES["everything"], target, name="A")
    assert {path: path.read_bytes() for path in target.parent.iterdir()} == before


def test_more_than_the_header_can_say_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(container, "MAX_FILE_BYTES", 1000)
    with pytest.raises(AssetError, match="4 GiB"):
        write_asset(SURFACES["everything"], tmp_path / "a.glb", name="A")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("damage, sentence", [
    (lambda data: data[:40], "is cut off"), (lambda data: b"PK" + data[2:], "is not a .glb file"), (lambda data: data[:7], "is not a .glb"),
    (lambda data: data[:4] + b"\x01" + data[5:], "version 2"), (lambda data: data[:20] + b"]" + data[21:], "no glTF document")])
def test_damaged_files_are_refused(damage, sentence, tmp_path):
    path = write_asset(SURFACES["2x2"], tmp_path / "a.glb", name="A").path
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(AssetError, match=sentence) as raised:
        read_glb(path)
    assert str(path) in str(raised.value)


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


@pytest.mark.parametrize("name, value, sentence", [
    ("POSITION", np.float32(np.nan), "1 of its [0-9]+ values of POSITION are not finite"),
    ("TEXCOORD_0", np.float32(np.inf), "1 of its [0-9]+ values of TEXCOORD_0 are not finite"),
    ("indices", np.uint16(60000), "has a face of vertex 60000, and"),
    ("image", b"damaged!", "is no image that can be read, or a damaged one"),
])
def test_faults_of_geometry_and_textures_are_errors(name, value, sentence, tmp_path):
    path = overwritten(written(tmp_path), view_of(name), value if isinstance(value, bytes) else value.tobytes())
    assert any(re.search(sentence, error) for error in inspect_glb(path).errors)


def test_attributes_of_other_lengths_and_accessors_that_are_not_there_are_errors(tmp_path):
    def shorter(document):
        document["accessors"][document["meshes"][0]["primitives"][0]["attributes"]["TEXCOORD_0"]]["count"] -= 1

    def absent(document):
        document["meshes"][0]["primitives"][0]["attributes"]["NORMAL"] = 99

    assert "values of TEXCOORD_0" in inspect_glb(rewritten(written(tmp_path), shorter)).errors[0]
    assert "refers to accessor 99, which is not there" in inspect_glb(rewritten(written(tmp_path), absent)).errors[0]


def attribute(document, name):
    return document["accessors"][document["meshes"][0]["primitives"][0]["attributes"][name]]


@pytest.mark.parametrize("change, sentence", [
    (lambda document: attribute(document, "POSITION").update(min=[-1, -1, -1]),
     r"POSITION: min of its accessor is \(-1, -1, -1\), and that of"),
    (lambda document: attribute(document, "POSITION")["max"].pop(), "POSITION: max of its accessor"),
    (lambda document: attribute(document, "POSITION").pop("min"), "POSITION: its accessor has no min and max"),
    (lambda document: document["meshes"][0]["primitives"][0]["attributes"].pop("TEXCOORD_0"),
     "has no TEXCOORD_0, by which its material reads baseColorTexture, metallicRoughnessTexture, normalTexture"),
    (lambda document: document["materials"][0]["normalTexture"].update(texCoord=1), "has no TEXCOORD_1, .* reads normalTexture"),
    (lambda document: document["meshes"][0]["primitives"][0]["attributes"].update(NORMAL=document["meshes"][0]["primitives"][0][
        "attributes"]["POSITION"]), r"NORMAL: (\d+) of its \1 values are not of length 1 but from"),
])
def test_what_a_document_says_wrongly_of_its_arrays_is_an_error(change, sentence, tmp_path):
    errors = inspect_glb(rewritten(written(tmp_path), change)).errors
    assert len(errors) == 1 and re.search(sentence, errors[0])


@pytest.mark.parametrize("name, value, sentence", [
    ("NORMAL", (0, 0, 0.5), "NORMAL: 1 of its .* values are not of length 1 but from 0.5 to 0.5 long"),
    ("NORMAL", (0, 0, 1.005), None),  # as bytes and halves have it
    ("TANGENT", (1, 0, 0, 0), "TANGENT: the fourth component of 1 of its"),
])
def test_directions_have_length_1(name, value, sentence, tmp_path):
    errors = inspect_glb(overwritten(written(tmp_path), view_of(name), np.float32(value).tobytes())).errors
    assert len(errors) == (sentence is not None) and all(re.search(str(sentence), error) for error in errors)


@pytest.mark.parametrize("kept, text", [(1, None), (0.5, None), (1, "%%%%")])
def test_images_within_the_document_are_read(kept, text, tmp_path):
    path = written(tmp_path)
    document, rest = chunks(path)
    view = document["bufferViews"][document["images"][0]["bufferView"]]
    data = rest[8 + view["byteOffset"]:][:view["byteLength"]]
    uri = f"data:image/png;base64,{text or b64encode(data[:round(kept * len(data))]).decode()}"
    found = inspect_glb(rewritten(path, lambda document: document["images"].__setitem__(0, {"uri": uri})))
    whole = text is None and kept == 1
    assert [each.partition(": ")[2] for each in found.errors] == (
        [] if whole else ["image 0 is no image that can be read, or a damaged one"])
    assert found.warnings == ()
    assert found.parts[2].facts.get("resolution") == ([24, 24] if text is None else None)
