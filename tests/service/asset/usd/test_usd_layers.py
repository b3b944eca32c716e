"""The layers of an asset: variants that replace and bind, extents, names, and provenance wherever one looks."""

import json
from pathlib import Path

import numpy as np
import pytest
from pxr import Sdf, Usd, UsdGeom, UsdShade, Vt

from service.asset.usd.asset import write_asset
from service.asset.usd.files import install, temporary_folder_beside
from service.asset.usd.layers import LAYER_FILES, AssetLayers, Description, prim_name
from service.asset.usd.scene import define_points
from stage.capture.camera import Camera
from stage.results.depth_maps import DepthMaps
from stage.stack.fingerprint import digest
from tests.clients.validators import findings
from tests.scenes.surfaces import make_ball

SUFFIXES = (".usda", ".usdc", ".usdz")
every_suffix = pytest.mark.parametrize("suffix", SUFFIXES)
CAMERA = Camera.model_validate({"projection": "orthographic", "resolution": [8, 8], "pixel_size_m": 0.5})
CORNERS = np.array([[0, 0, 0], [2, 0, 0], [2, 3, 0], [0, 3, 0]], np.float32)


def define_square(usd_stage, path, size):
    mesh = UsdGeom.Mesh.Define(usd_stage, path)
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(CORNERS * np.float32(size)))
    mesh.CreateFaceVertexCountsAttr([4])
    mesh.CreateFaceVertexIndicesAttr([0, 1, 2, 3])
    mesh.CreateNormalsAttr([(0, 0, 1)] * 4)
    mesh.SetNormalsInterpolation("vertex")
    mesh.CreateExtentAttr(UsdGeom.Mesh.ComputeExtent(mesh.GetPointsAttr().Get()))
    return mesh


def define_paint(usd_stage, path):
    material = UsdShade.Material.Define(usd_stage, path)
    surface = UsdShade.Shader.Define(usd_stage, path.AppendChild("Surface"))
    surface.CreateIdAttr("UsdPreviewSurface")
    material.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", Sdf.ValueTypeNames.Token))
    return material


def write_square(target: Path) -> None:
    """A square with a smaller one and points in its place, in two looks."""
    with temporary_folder_beside(target) as temporary:
        layers = AssetLayers(temporary, target, Description("Square", CAMERA, {"relit:capture": "sq"}, version="v007"))
        with layers.geometry_variant("mesh") as geom:
            layers.add_surface(define_square(layers.geometry, geom.AppendChild("Mesh"), 2).GetPath())
        with layers.geometry_variant("lod1") as geom:
            layers.add_surface(define_square(layers.geometry, geom.AppendChild("MeshLod1"), 1).GetPath())
        with layers.geometry_variant("points") as geom:
            define_points(layers.geometry, geom.AppendChild("Points"), CORNERS, np.array([1.0]), normals=None)
        UsdGeom.Scope.Define(layers.materials, layers.looks)
        layers.add_look("matte", define_paint(layers.materials, layers.looks.AppendChild("Matte")))
        layers.add_look("gloss", define_paint(layers.materials, layers.looks.AppendChild("Gloss")))
        layers.save()
        first, *others = layers.files
        install(target, first, others, ours=LAYER_FILES)


def select(usd_stage, **variants):
    for name, value in variants.items():
        assert usd_stage.GetDefaultPrim().GetVariantSets().GetVariantSet(name).SetVariantSelection(value)


@every_suffix
def test_each_variant_shows_its_geometry_alone_with_its_extents(suffix, tmp_path):
    write_square(tmp_path / f"square{suffix}")
    usd_stage = Usd.Stage.Open(str(tmp_path / f"square{suffix}"))
    usd_stage.SetEditTarget(usd_stage.GetSessionLayer())
    root = usd_stage.GetDefaultPrim()
    assert root.GetVariantSets().GetVariantSet("geo").GetVariantSelection() == "mesh"
    assert root.GetVariantSets().GetVariantSet("geo").GetVariantNames() == ["lod1", "mesh", "points"]
    hints = {"mesh": [(0, 0, 0), (4, 6, 0)], "lod1": [(0, 0, 0), (2, 3, 0)], "points": [(-0.5, -0.5, -0.5), (2.5, 3.5, 0.5)]}
    for variant, prim in (("mesh", "Mesh"), ("lod1", "MeshLod1"), ("points", "Points")):
        select(usd_stage, geo=variant)
        assert [p.GetName() for p in usd_stage.Traverse() if p.IsA(UsdGeom.Boundable)] == [prim]
        assert [tuple(corner) for corner in UsdGeom.ModelAPI(root).GetExtentsHint()] == hints[variant]
    arkit = "ARKit, points"  # which knows no points without a material
    assert [found for found in findings(tmp_path / f"square{suffix}") if not found.startswith(arkit)] == []


@every_suffix
def test_each_look_binds_its_material_to_every_surface(suffix, tmp_path):
    write_square(tmp_path / f"square{suffix}")
    usd_stage = Usd.Stage.Open(str(tmp_path / f"square{suffix}"))
    usd_stage.SetEditTarget(usd_stage.GetSessionLayer())
    for geo, prim in (("mesh", "Mesh"), ("lod1", "MeshLod1")):
        for look, material in ((None, "Matte"), ("gloss", "Gloss"), ("matte", "Matte")):
            select(usd_stage, geo=geo, **({} if look is None else {"look": look}))
            bound, _ = UsdShade.MaterialBindingAPI(usd_stage.GetPrimAtPath(f"/Square/Geom/{prim}")).ComputeBoundMaterial()
            assert bound.GetPath() == f"/Square/Looks/{material}"
    select(usd_stage, geo="points")
    assert not UsdShade.MaterialBindingAPI(usd_stage.GetPrimAtPath("/Square/Geom/Points")).ComputeBoundMaterial()[0]


@pytest.mark.parametrize("suffix", [".usda", ".usdc"])
def test_the_interface_tells_variants_and_extents_without_its_payload(suffix, tmp_path):
    write_square(tmp_path / f"square{suffix}")
    assert {str(p.relative_to(tmp_path)) for p in tmp_path.rglob("*") if p.is_file()} == {
        f"square{suffix}", *(f"square_layers/{name}" for name in LAYER_FILES)}
    usd_stage = Usd.Stage.Open(str(tmp_path / f"square{suffix}"), Usd.Stage.LoadNone)
    root = usd_stage.GetDefaultPrim()
    assert [p.GetPath() for p in usd_stage.Traverse()] == []  # nothing is loaded: Traverse leaves out what is not
    assert root.HasAuthoredPayloads() and Usd.ModelAPI(root).GetKind() == "component"
    assert root.GetVariantSets().GetAllVariantSelections() == {"geo": "mesh", "look": "matte"}
    assert root.GetVariantSets().GetVariantSet("look").GetVariantNames() == ["gloss", "matte"]
    assert tuple(UsdGeom.ModelAPI(root).GetExtentsHint()[1]) == (4, 6, 0)


def test_every_layer_says_where_it_comes_from(tmp_path):
    write_square(tmp_path / "square.usda")
    for file in tmp_path.rglob("*.usd?"):
        layer = Sdf.Layer.FindOrOpen(str(file))
        assert layer.customLayerData["relit"] == {"capture": "sq", "camera": CAMERA.model_dump_json()}, file
        assert layer.defaultPrim == "Square" and "Relit" in layer.documentation
        assert layer.pseudoRoot.GetInfo("upAxis") == "Y" and layer.pseudoRoot.GetInfo("metersPerUnit") == 1


@every_suffix
def test_a_shot_that_refers_to_the_asset_chooses_variants_and_finds_its_provenance(suffix, tmp_path):
    write_square(tmp_path / f"square{suffix}")
    shot = Usd.Stage.CreateInMemory()
    prim = shot.DefinePrim("/Shot/Square")
    prim.GetReferences().AddReference(str(tmp_path / f"square{suffix}"))
    for name, value in (("geo", "lod1"), ("look", "gloss")):
        prim.GetVariantSets().GetVariantSet(name).SetVariantSelection(value)
    mesh, = (p for p in shot.Traverse() if p.IsA(UsdGeom.Boundable))
    assert mesh.GetPath() == "/Shot/Square/Geom/MeshLod1"
    assert UsdShade.MaterialBindingAPI(mesh).ComputeBoundMaterial()[0].GetPath() == "/Shot/Square/Looks/Gloss"
    assert tuple(UsdGeom.ModelAPI(prim).GetExtentsHint()[1]) == (2, 3, 0)
    assert prim.GetAssetInfoByKey("relit:capture") == "sq" and Usd.ModelAPI(prim).GetAssetVersion() == "v007"


def test_an_exported_asset_has_the_whole_path_of_its_provenance(relit, tmp_path, ball):
    ball.write(tmp_path / "maps.exr")
    relit.done("export", tmp_path, "--out", tmp_path / "a.usdz", "--name", "Kugel", "--version", "3")
    usd_stage = Usd.Stage.Open(str(tmp_path / "a.usdz"))
    found = usd_stage.GetMetadata("customLayerData")["relit"]
    assert found["method"] == "svbrdf" and found["maps"] == digest(tmp_path / "maps.exr")
    assert {"name": "Kugel", "version": "3"}.items() <= json.loads(found["export_options"]).items() and found["export_version"]
    assert Usd.ModelAPI(usd_stage.GetDefaultPrim()).GetAssetVersion() == "3"


@pytest.mark.parametrize("other", ["a file", "a link"])
def test_something_else_in_place_of_a_folder_is_refused(other, tmp_path):
    place = tmp_path / "square_layers"
    if other == "a file":
        place.write_text("notes")
    else:
        place.symlink_to(tmp_path / "elsewhere", target_is_directory=True)
    with pytest.raises(OSError, match="square_layers is no folder, and the asset needs a folder of"):
        write_square(tmp_path / "square.usda")
    assert [p.name for p in tmp_path.iterdir()] == ["square_layers"]


def test_every_text_gives_a_valid_name():
    for text in ("", " ", "…", "9", "_", "ÄÖ", "日本語", "👩🏽‍🚀", "a/b:c", "x" * 300):
        assert Sdf.Path.IsValidIdentifier(prim_name(text))


@pytest.mark.long
@pytest.mark.parametrize("suffix", [".usda", ".usdc", ".usdz"])
def test_levels_are_variants_with_the_material_of_the_mesh(suffix, tmp_path):
    report = write_asset(make_ball(64), tmp_path / f"ball{suffix}", name="Ball", levels=2)
    usd_stage = Usd.Stage.Open(str(tmp_path / f"ball{suffix}"))
    assert findings(tmp_path / f"ball{suffix}") == []
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
