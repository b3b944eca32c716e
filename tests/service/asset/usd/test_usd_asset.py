"""Assets on disk: what is in them, what other tools say to them, and what is left when something fails."""

import dataclasses
import errno
import os
import zipfile
from pathlib import Path

import numpy as np
import pytest
from pxr import Usd, UsdGeom, UsdShade, UsdValidation

from service.asset.usd import files
from service.asset.usd.asset import write_asset
from service.asset.usd.depth_asset import write_points
from service.errors import AssetError
from stage.errors import StorageError
from stage.formats.ply import PointCloud
from stage.results.maps import SurfaceMaps
from tests.clients.validators import findings
from tests.scenes.surfaces import make_ball, make_sheet, make_wave
from tests.service.full_disk import files_of_at_most

SUFFIXES = (".usda", ".usdc", ".usdz")
BALL_TEXTURES = ("base_color", "roughness", "normal", "diffuse_albedo", "specular")
"""Textures of a ball without metal, in the order of the package."""
every_suffix = pytest.mark.parametrize("suffix", SUFFIXES)
POSE = ((0.0, 0.0, 1.0, 0.3), (1.0, 0.0, 0.0, -0.1), (0.0, 1.0, 0.0, 2.0), (0.0, 0.0, 0.0, 1.0))

SURFACES = {
    "everything": make_ball(), "diffuse only": make_ball(specular=None, roughness=None),
    "height only": make_wave("perspective", world_from_camera=POSE), "no scale": make_wave("orthographic"),
    "bow tie": make_sheet(np.array([[1, 0, 0], [1, 1, 1], [0, 0, 1]], dtype=bool)),
    "2x2": make_sheet(np.ones((2, 2), dtype=bool), diffuse_albedo=np.full((2, 2, 3), 0.5, dtype=np.float32)),
}
KINDS = [("everything", suffix) for suffix in SUFFIXES] + [(name, ".usdz") for name in SURFACES if name != "everything"]
every_kind = pytest.mark.parametrize(("surface", "suffix"), KINDS)


def listing(folder: Path) -> dict[str, bytes]:
    """Every file below a folder with its bytes."""
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def tilted_ball() -> SurfaceMaps:
    """A ball whose normal map does not compress, so that it is larger than the other textures."""
    ball = make_ball(48)
    noise = np.random.default_rng(1).normal(size=ball.normal.shape) * 0.1
    return dataclasses.replace(ball, normal=(ball.normal + noise).astype(np.float32))


def shader(usd_stage, name):
    return UsdShade.Shader(usd_stage.GetPrimAtPath(f"/Ball/Looks/Material/{name}"))


@every_kind
def test_validators_find_nothing(surface, suffix, tmp_path):
    write_asset(SURFACES[surface], tmp_path / f"ball{suffix}", name="Ball")
    assert len(UsdValidation.ValidationRegistry().GetOrLoadAllValidators()) >= 30
    assert findings(tmp_path / f"ball{suffix}") == []


@every_suffix
def test_prims_and_metadata(ball, suffix, tmp_path):
    write_asset(ball, tmp_path / f"ball{suffix}", name="Ball")
    usd_stage = Usd.Stage.Open(str(tmp_path / f"ball{suffix}"))
    root = usd_stage.GetDefaultPrim()
    assert root.GetPath() == "/Ball" and Usd.ModelAPI(root).GetKind() == "component"
    assert UsdGeom.GetStageUpAxis(usd_stage) == "Y" and UsdGeom.GetStageMetersPerUnit(usd_stage) == 1.0
    assert usd_stage.GetMetadataByDictKey("customLayerData", "relit:method") == "svbrdf"
    assert usd_stage.GetMetadataByDictKey("customLayerData", "relit:camera") == ball.camera.model_dump_json()
    assert not UsdGeom.Xformable(root).GetOrderedXformOps() and not root.HasCustomDataKey("relit:scale")

    mesh = UsdGeom.Mesh(usd_stage.GetPrimAtPath("/Ball/Geom/Mesh"))
    points = np.array(mesh.GetPointsAttr().Get())
    extent = np.array(mesh.GetExtentAttr().Get())
    np.testing.assert_array_equal(extent, [points.min(axis=0), points.max(axis=0)])
    np.testing.assert_array_equal(np.array(UsdGeom.ModelAPI(root).GetExtentsHint()), extent)
    assert mesh.GetSubdivisionSchemeAttr().Get() == "none" and mesh.GetDoubleSidedAttr().Get()
    assert mesh.GetNormalsInterpolation() == "vertex" and len(mesh.GetNormalsAttr().Get()) == len(points)
    bound, _ = UsdShade.MaterialBindingAPI(mesh).ComputeBoundMaterial()
    assert bound.GetPath() == "/Ball/Looks/Material"


def test_pose_is_the_transform_of_the_root(ball, tmp_path):
    for camera, unit_m in ((ball.camera, 1.0), (ball.camera.model_copy(update={"pixel_size_m": None}), 0.001)):
        posed = dataclasses.replace(ball, camera=camera.model_copy(update={"world_from_camera": POSE}))
        write_asset(posed, tmp_path / f"{unit_m}.usdc", name="Ball")
        usd_stage = Usd.Stage.Open(str(tmp_path / f"{unit_m}.usdc"))
        matrix = np.array(UsdGeom.XformCache().GetLocalToWorldTransform(usd_stage.GetDefaultPrim())).T
        np.testing.assert_allclose(matrix[:3, :3], np.array(POSE)[:3, :3])
        np.testing.assert_allclose(matrix[:3, 3] * unit_m, np.array(POSE)[:3, 3])  # metres, whatever the scene unit


def test_unknown_scale_is_said(tmp_path):
    write_asset(SURFACES["no scale"], tmp_path / "ball.usdz", name="Ball")
    usd_stage = Usd.Stage.Open(str(tmp_path / "ball.usdz"))
    assert UsdGeom.GetStageMetersPerUnit(usd_stage) == 0.001
    assert usd_stage.GetDefaultPrim().GetCustomDataByKey("relit:scale").startswith("unknown")


@pytest.mark.parametrize("name, prim", [("owl 2", "owl_2"), ("2nd try", "_2nd_try"), ("Eule – groß", "Eule_gross"),
                                        ("フクロウ", "fukurou"), ("🦉", "owl"), ("a//b.usd", "a_b_usd"), ("", "Asset")])
def test_prim_name_is_made_valid(name, prim, ball, tmp_path):
    write_asset(ball, tmp_path / "ball.usdc", name=name)
    usd_stage = Usd.Stage.Open(str(tmp_path / "ball.usdc"))
    root = usd_stage.GetDefaultPrim()
    assert root.GetDisplayName() == name and root.GetName() == prim


def test_usdz_is_the_layer_first_then_textures_stored_and_aligned(ball, tmp_path):
    report = write_asset(ball, tmp_path / "ball.usdz", name="Ball")
    assert [p.name for p in tmp_path.iterdir()] == ["ball.usdz"] and report.textures == ()
    data = report.path.read_bytes()
    entries = zipfile.ZipFile(report.path).infolist()
    assert [e.filename for e in entries] == ["ball.usdc", *(f"ball_textures/{name}.png" for name in BALL_TEXTURES)]
    for entry in entries:
        name_length, extra_length = (int.from_bytes(data[entry.header_offset + at:][:2], "little") for at in (26, 28))
        assert entry.compress_type == zipfile.ZIP_STORED
        assert (entry.header_offset + 30 + name_length + extra_length) % 64 == 0
    usd_stage = Usd.Stage.Open(str(report.path))
    file = shader(usd_stage, "Normal").GetInput("file").Get()
    assert file.resolvedPath.endswith("ball.usdz[ball_textures/normal.png]")


@every_suffix
def test_the_report_says_what_was_written(suffix, tmp_path):
    albedo = np.full((24, 24, 3), 2.0, dtype=np.float32)
    maps = make_ball(diffuse_albedo=albedo)
    report = write_asset(maps, tmp_path / f"a{suffix}", name="A")
    assert report.path == tmp_path / f"a{suffix}" and report.step == 1
    assert report.clipped_pixels == dict.fromkeys(BALL_TEXTURES, 0) | {"diffuse_albedo": maps.mask.sum()}
    assert [warning.partition(":")[0] for warning in report.warnings] == ["material"]  # the base colour ends at 1
    assert all(p.is_file() for p in report.textures) and len(report.textures) == (0 if suffix == ".usdz" else 6)


@every_suffix
def test_the_same_maps_give_the_same_bytes(ball, suffix, tmp_path):
    for folder in ("one", "two"):
        write_asset(ball, tmp_path / folder / f"ball{suffix}", name="Ball")
    assert listing(tmp_path / "one") == listing(tmp_path / "two")


@every_suffix
def test_export_over_an_older_asset(ball, suffix, tmp_path):
    write_asset(ball, tmp_path / f"ball{suffix}", name="Ball")
    if suffix != ".usdz":
        (tmp_path / "ball_textures" / "painted.png").write_bytes(b"by hand")
    write_asset(SURFACES["diffuse only"], tmp_path / f"ball{suffix}", name="Ball")
    usd_stage = Usd.Stage.Open(str(tmp_path / f"ball{suffix}"))
    usd_stage.Reload()
    assert shader(usd_stage, "Surface").GetInput("ior").Get() == 1
    if suffix != ".usdz":
        kept = sorted(p.name for p in (tmp_path / "ball_textures").iterdir())
        assert kept == ["base_color.png", "normal.png", "openpbr.mtlx", "painted.png"]  # what is not ours stays
    assert not [p for p in tmp_path.iterdir() if p.name.startswith(".")]


def test_failure_of_the_last_rename_brings_the_older_textures_back(ball, tmp_path, monkeypatch):
    write_asset(SURFACES["diffuse only"], tmp_path / "ball.usda", name="Ball")
    before = listing(tmp_path)

    def fail(source, destination):
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(files.os, "replace", fail)
    with pytest.raises(StorageError, match="input/output error"):
        write_asset(ball, tmp_path / "ball.usda", name="Ball")
    assert listing(tmp_path) == before and all(not p.name.startswith(".") for p in tmp_path.iterdir())


@pytest.mark.long
@pytest.mark.parametrize("older", [False, True], ids=["nothing before", "older asset"])
def test_failure_of_any_rename_brings_both_older_folders_back(ball, older, tmp_path, monkeypatch):
    if older:
        write_asset(SURFACES["diffuse only"], tmp_path / "ball.usda", name="Ball")
        (tmp_path / "ball_layers" / "shot.usda").write_text("#usda 1.0")
    before = listing(tmp_path)
    rename = os.rename
    renames = 5 if older else 2  # of layers and textures: away, and into place; of a file that is not ours
    for failing, error in ((n, e) for n in range(renames) for e in (OSError(errno.EIO, "Input/output error"), KeyboardInterrupt())):
        calls = []

        def fail_once(source, destination, failing=failing, error=error, calls=calls):
            calls.append(destination)
            if len(calls) == failing + 1:
                raise error
            rename(source, destination)

        monkeypatch.setattr(files.os, "rename", fail_once)
        with pytest.raises((StorageError, KeyboardInterrupt)):
            write_asset(ball, tmp_path / "ball.usda", name="Ball")
        assert listing(tmp_path) == before and all(not p.name.startswith(".") for p in tmp_path.iterdir())


@pytest.mark.parametrize("suffix, stops_in, spared", [(".usdc", "normal.png", 300), (".usda", "geometry.usdc", 1),
                                                      (".usdc", "geometry.usdc", 1), (".usdz", "package", 1)])
def test_a_disk_that_really_refuses(suffix, stops_in, spared, tmp_path):
    """The operating system cuts the file off shortly before its end: writers that do not look would call that done."""
    maps = tilted_ball()
    maps.write(tmp_path / "maps.exr")
    whole = write_asset(SurfaceMaps.read(tmp_path / "maps.exr"), tmp_path / f"whole{suffix}", name="Ball")
    file = next((p for p in tmp_path.rglob(stops_in)), whole.path)
    limit = file.stat().st_size - spared
    before = [p for p in whole.textures if p.name < "normal.png"] if stops_in == "normal.png" else whole.textures
    assert all(p.stat().st_size < limit for p in before)  # so that they are not what is refused
    target = tmp_path / "out" / f"whole{suffix}"
    if older := suffix != ".usdc":
        write_asset(SURFACES["diffuse only"], target, name="Ball")
    older_files = listing(target.parent) if older else []
    with files_of_at_most(limit), pytest.raises(StorageError, match=f"^cannot write {target}: ") as raised:
        write_asset(SurfaceMaps.read(tmp_path / "maps.exr"), target, name="Ball")
    assert "pxr" not in str(raised.value)  # a sentence, not a place in the source of USD
    assert (stops_in in str(raised.value)) == stops_in.endswith(".png")
    assert (listing(target.parent) if older else list(target.parent.iterdir())) == older_files


def test_a_disk_that_refuses_a_layer_of_text(tmp_path):
    cloud = PointCloud(np.linspace(0, 1, 3000, dtype=np.float32).reshape(-1, 3), np.zeros((1000, 3), np.uint8), None)
    write_points(cloud, tmp_path / "whole.usda", name="Cloud")
    target = tmp_path / "out" / "cloud.usda"
    limit = (tmp_path / "whole.usda").stat().st_size - 1
    with files_of_at_most(limit), pytest.raises(StorageError, match=f"^cannot write {target}: "):
        write_points(cloud, target, name="Cloud")
    assert list(target.parent.iterdir()) == []


@pytest.mark.parametrize("suffix", [".usd", ".obj", ""])
def test_unknown_suffix_names_the_known(ball, suffix, tmp_path):
    with pytest.raises(AssetError, match=r"\.usda, \.usdc or \.usdz"):
        write_asset(ball, tmp_path / f"ball{suffix}", name="Ball")
    assert list(tmp_path.iterdir()) == []
