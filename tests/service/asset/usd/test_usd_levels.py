"""Levels of detail in USD: variants of geo with one material, valid in every format; where they are not possible, a sentence."""

import numpy as np
import pytest
from pxr import Usd, UsdGeom, UsdShade, UsdValidation

from service.asset.usd.asset import write_asset
from stage.results.depth_maps import DepthMaps
from tests.scenes.surfaces import make_ball


@pytest.mark.long
@pytest.mark.parametrize("suffix", [".usda", ".usdc", ".usdz"])
def test_levels_are_variants_with_the_material_of_the_mesh(suffix, tmp_path):
    report = write_asset(make_ball(64), tmp_path / f"ball{suffix}", name="Ball", levels=2)
    usd_stage = Usd.Stage.Open(str(tmp_path / f"ball{suffix}"))
    errors = UsdValidation.ValidationContext(UsdValidation.ValidationRegistry().GetOrLoadAllValidators()).Validate(usd_stage)
    assert [(e.GetName(), e.GetMessage()) for e in errors] == []
    nvidia = pytest.importorskip("usd_validation_nvidia", reason="usd-validation-nvidia is not installed")
    issues = nvidia.ValidationEngine().validate(str(tmp_path / f"ball{suffix}")).issues()
    assert [i.message for i in issues if not (suffix == ".usda" and i.rule and i.rule.__name__ == "UsdAsciiPerformanceChecker")] == []

    root = usd_stage.GetDefaultPrim()
    variants = root.GetVariantSets().GetVariantSet("geo")
    assert set(variants.GetVariantNames()) == {"mesh", "lod1", "lod2"} and variants.GetVariantSelection() == "mesh"
    assert list(report.sizes) == ["mesh", "lod1", "lod2"]
    material = set()
    for name, (vertices, faces) in report.sizes.items():
        variants.SetVariantSelection(name)
        meshes = [UsdGeom.Mesh(prim) for prim in usd_stage.Traverse() if prim.IsA(UsdGeom.Mesh)]
        assert [str(mesh.GetPath()) for mesh in meshes] == [f"/Ball/Geom/{name.capitalize()}"]
        assert len(meshes[0].GetPointsAttr().Get()) == vertices and len(meshes[0].GetFaceVertexCountsAttr().Get()) == faces
        bound, _ = UsdShade.MaterialBindingAPI(meshes[0]).ComputeBoundMaterial()
        material.add(str(bound.GetPath()))
    assert len(material) == 1
    faces = [faces for _, faces in report.sizes.values()]
    assert faces[1] < 0.8 * faces[0] and faces[2] < 0.6 * faces[1]  # of the full mesh quads are counted, of levels triangles


def test_relit_export_prints_the_sizes(relit, tmp_path):
    make_ball(64).write(tmp_path / "maps.exr")
    outcome = relit("export", tmp_path, "--out", tmp_path / "ball.usdc", "--levels", 1)
    lines = [line.split() for line in outcome.out.splitlines()]
    assert [line[0] for line in lines] == ["asset", "mesh", "lod1"]
    assert [line[2::2] for line in lines[1:]] == [["vertices,", "faces"]] * 2
    usd_stage = Usd.Stage.Open(str(tmp_path / "ball.usdc"))
    mesh = next(UsdGeom.Mesh(prim) for prim in usd_stage.Traverse() if prim.IsA(UsdGeom.Mesh))
    assert lines[1][1::2] == [str(len(mesh.GetPointsAttr().Get())), str(len(mesh.GetFaceVertexCountsAttr().Get()))]


def test_levels_that_are_not_possible_are_refused(relit, tmp_path):
    maps = make_ball()
    (tmp_path / "solved").mkdir()
    maps.write(tmp_path / "solved" / "maps.exr")
    assert "--levels 2: a .glb holds one mesh" in relit.refused("export", tmp_path / "solved", "--out", tmp_path / "a.glb", "--levels", 2)
    assert relit("export", tmp_path / "solved", "--out", tmp_path / "a.usda", "--levels", 5).code == 2
    depth = DepthMaps(camera=maps.camera, mask=maps.mask, depth=np.where(maps.mask, 1, 0).astype(np.float32))
    depth.write(tmp_path / "depth.exr")
    assert "--levels 1: is for solved maps" in relit.refused("export", tmp_path, "--out", tmp_path / "a.usda", "--levels", 1)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["depth.exr", "solved"]
