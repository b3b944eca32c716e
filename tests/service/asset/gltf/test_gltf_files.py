"""The .glb as a file: the same every time, written whole or not at all, and read with care."""

import errno

import numpy as np
import pytest

from service.asset.gltf import container, scene
from service.asset.gltf.asset import write_asset
from service.asset.gltf.container import read_glb
from service.errors import AssetError
from service.export.export import export
from service.requests.export import ExportRequest, Geometry
from stage.capture.camera import Camera
from stage.errors import StorageError
from stage.results.depth_maps import DepthMaps
from tests.scenes.surfaces import make_ball, make_wave
from tests.service.asset.gltf.surfaces import SURFACES
from tests.service.full_disk import files_of_at_most


def test_the_same_maps_give_the_same_bytes(tmp_path):
    one, two = (write_asset(SURFACES["everything"], tmp_path / folder / "a.glb", name="A").path.read_bytes() for folder in ("1", "2"))
    assert one == two


@pytest.mark.parametrize("older", [False, True], ids=["nothing before", "older asset"])
def test_full_disk_in_a_texture_leaves_no_trace(older, tmp_path, monkeypatch):
    target = tmp_path / "a.glb"
    if older:
        write_asset(SURFACES["diffuse only"], target, name="A")
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    written = scene.write_png

    def fail(path, codes, *, srgb):
        if path.name == "normal.png":  # the last
            raise OSError(errno.ENOSPC, "No space left on device")
        written(path, codes, srgb=srgb)

    monkeypatch.setattr(scene, "write_png", fail)
    with pytest.raises(StorageError, match="no space left on device") as raised:
        write_asset(SURFACES["everything"], target, name="A")
    assert str(target) in str(raised.value)
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


@pytest.mark.long
def test_a_disk_that_really_refuses(tmp_path):
    whole = write_asset(SURFACES["everything"], tmp_path / "whole.glb", name="A").path
    target = tmp_path / "out" / "a.glb"
    with files_of_at_most(whole.stat().st_size - 100), pytest.raises(StorageError, match=f"cannot write {target}: "):
        write_asset(SURFACES["everything"], target, name="A")
    assert list(target.parent.iterdir()) == []


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


def test_an_unknown_suffix_names_the_known(tmp_path):
    make_ball().write(tmp_path / "maps.exr")
    with pytest.raises(AssetError, match=r"\.usda, \.usdc or \.usdz for USD, or \.glb for glTF"):
        export(ExportRequest(maps=tmp_path, out=tmp_path / "a.gltf"))
    assert [path.name for path in tmp_path.iterdir()] == ["maps.exr"]
