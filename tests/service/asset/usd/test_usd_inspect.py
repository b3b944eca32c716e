"""The findings of relit inspect about USD assets that are right, and about broken ones."""

import json
import re
import shutil
import zipfile

import numpy as np
import pytest
from pxr import Sdf, Usd, UsdGeom, UsdLux, UsdShade

from service.asset.content.mesh import height_mesh
from service.asset.content.metallic import metallic_look
from service.asset.usd.asset import write_asset
from service.asset.usd.inspect import inspect_usd
from service.asset.usd.layers import LAYER_FILES
from service.errors import AssetError
from stage.formats.images import write_png
from tests.scenes.surfaces import make_ball, make_wave

SUFFIXES = (".usda", ".usdc", ".usdz")


def of_kind(found, kind):
    return [part for part in found.parts if part.kind == kind]


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_ball(ball, suffix, tmp_path):
    path = tmp_path / f"ball{suffix}"
    report = write_asset(ball, path, name="Kugel", version="v2")
    found = inspect_usd(path)
    facts = found.facts
    assert (found.errors, found.warnings) == ((), ())
    assert (facts["default_prim"], facts["kind"], facts["up_axis"], facts["meters_per_unit"]) == ("/Kugel", "component", "Y", 1.0)
    assert facts["asset_info"] == {"name": "Kugel", "identifier": f"ball{suffix}", "version": "v2"}  # the rest is provenance
    assert metallic_look(ball).provenance.items() <= found.provenance.items() and found.provenance["relit:method"] == "svbrdf"
    assert facts["notes"] == {}  # not the documentation that OpenUSD has of every Xform
    assert facts["layers"] == ([] if suffix == ".usdz" else [f"ball_layers/{name}" for name in (
        "geometry.usdc", "materials.usda", "payload.usda")])
    assert facts["variants"] == {"geo": ["mesh"], "look": ["metallic", "specular"]} and facts["selections"]["look"] == "metallic"
    referred = [p for p in tmp_path.rglob("*") if p.is_file() and p.suffix != ".mtlx"]
    assert found.size_bytes == sum(p.stat().st_size for p in referred)
    np.testing.assert_allclose(facts["extent_m"], height_mesh(ball).extent, atol=1e-6)
    mesh, = of_kind(found, "mesh")
    assert mesh.name == "/Kugel/Geom/Mesh" and (mesh.facts["vertices"], mesh.facts["faces"]) == report.sizes["mesh"]
    assert (mesh.facts["purpose"], mesh.facts["primvars"]) == ("default", ["st vertex"])
    camera, far = of_kind(found, "camera")
    assert (camera.name, far.name) == ("/Kugel/Camera", "/Kugel/CameraPerspective")
    assert camera.facts["orthographic_m"] == pytest.approx([24 * ball.camera.pixel_size_m] * 2)
    shaders = {(part.facts["context"], part.variant): part.facts["shader"] for part in of_kind(found, "material")}
    assert shaders == {("universal", ""): "UsdPreviewSurface", ("mtlx", ""): "ND_open_pbr_surface_surfaceshader",
                       ("universal", "look=specular"): "UsdPreviewSurface"}
    textures = {part.name: part.facts for part in of_kind(found, "texture")}
    assert all(facts["resolution"] == [24, 24] for facts in textures.values())
    colour = textures["/Kugel/Looks/Material universal:diffuseColor"]
    assert (colour["color_space"], colour["channels"], colour["depth"]) == ("sRGB", 3, "uint16")


def test_the_capturing_angle_of_view_in_degrees(tmp_path):
    maps = make_wave("perspective")
    write_asset(maps, tmp_path / "a.usdz", name="a")
    angles = [2 * np.degrees(np.arctan(side / 2 / focal)) for side, focal in zip(maps.camera.resolution, maps.camera.focal_px, strict=True)]
    camera, = of_kind(inspect_usd(tmp_path / "a.usdz"), "camera")
    assert camera.facts["perspective_degrees"] == pytest.approx(angles, rel=1e-5)


def test_a_moving_mesh_is_looked_at_where_it_begins(tmp_path):
    usd_stage = Usd.Stage.CreateNew(str(tmp_path / "moving.usda"))
    mesh = UsdGeom.Mesh.Define(usd_stage, "/Mesh")
    usd_stage.SetDefaultPrim(mesh.GetPrim())
    mesh.CreateFaceVertexCountsAttr([3])
    mesh.CreateFaceVertexIndicesAttr([0, 1, 2])
    for time in (1, 2):
        mesh.GetPointsAttr().Set([(time, 0, 0), (time, 1, 0), (time + 1, 0, 0)], time)
    usd_stage.SetStartTimeCode(1)
    usd_stage.SetEndTimeCode(2)
    usd_stage.SetTimeCodesPerSecond(25)
    usd_stage.Save()
    found = inspect_usd(tmp_path / "moving.usda")
    mesh, = of_kind(found, "mesh")
    assert (mesh.facts["vertices"], mesh.facts["faces"]) == (3, 1)
    assert (found.facts["time_codes"], found.facts["time_codes_per_second"]) == ([1, 2], 25)


def test_a_variant_of_the_geometry_may_have_a_material_and_images_of_its_own(tmp_path):
    write_png(tmp_path / "card.1.png", np.zeros((2, 3, 3), np.uint8), srgb=True)
    usd_stage = Usd.Stage.CreateNew(str(tmp_path / "a.usda"))
    root = UsdGeom.Xform.Define(usd_stage, "/A").GetPrim()
    usd_stage.SetDefaultPrim(root)
    for name in ("Paint", "Card"):
        material = UsdShade.Material.Define(usd_stage, f"/A/{name}")
        surface = UsdShade.Shader.Define(usd_stage, f"/A/{name}/Surface")
        surface.CreateIdAttr("UsdPreviewSurface")
        material.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", Sdf.ValueTypeNames.Token))
    image = UsdShade.Shader.Define(usd_stage, "/A/Card/Image")
    image.CreateIdAttr("UsdUVTexture")
    image.CreateInput("file", Sdf.ValueTypeNames.Asset).Set(Sdf.AssetPath("./card.1.png"), 1)
    surface.CreateInput("emissiveColor", Sdf.ValueTypeNames.Color3f).ConnectToSource(image.CreateOutput("rgb", Sdf.ValueTypeNames.Float3))
    square = UsdGeom.Plane.Define(usd_stage, "/A/Square").GetPrim()
    variants = root.GetVariantSets().AddVariantSet("geo")
    for variant, name in (("card", "Card"), ("mesh", "Paint")):
        variants.AddVariant(variant)
        variants.SetVariantSelection(variant)
        with variants.GetVariantEditContext():
            UsdShade.MaterialBindingAPI.Apply(square).Bind(UsdShade.Material(usd_stage.GetPrimAtPath(f"/A/{name}")))
    usd_stage.Save()
    found = inspect_usd(tmp_path / "a.usda")
    assert [(part.variant, part.name) for part in of_kind(found, "material")] == [("", "/A/Paint"), ("geo=card", "/A/Card")]
    texture, = of_kind(found, "texture")
    assert (texture.facts["file"], texture.facts["resolution"]) == ("./card.1.png", [3, 2])


def test_lights_are_those_of_each_variant(tmp_path):
    usd_stage = Usd.Stage.CreateNew(str(tmp_path / "lit.usda"))
    root = UsdGeom.Xform.Define(usd_stage, "/Set").GetPrim()
    usd_stage.SetDefaultPrim(root)
    UsdLux.DomeLight.Define(usd_stage, "/Set/Sky")
    variants = root.GetVariantSets().AddVariantSet("light")
    for name in ("off", "key"):
        variants.AddVariant(name)
    variants.SetVariantSelection("key")
    with variants.GetVariantEditContext():
        UsdLux.DistantLight.Define(usd_stage, "/Set/Key")
    variants.SetVariantSelection("off")
    usd_stage.Save()
    assert [part[:3] for part in of_kind(inspect_usd(tmp_path / "lit.usda"), "light")] == [
        ("light", "/Set/Sky", ""), ("light", "/Set/Key", "light=key")]


def test_layers_of_variants_that_are_not_chosen_are_files_of_the_asset(tmp_path):
    Sdf.Layer.CreateNew(str(tmp_path / "extra.usda")).Save()
    usd_stage = Usd.Stage.CreateNew(str(tmp_path / "a.usda"))
    root = UsdGeom.Xform.Define(usd_stage, "/A").GetPrim()
    usd_stage.SetDefaultPrim(root)
    variants = root.GetVariantSets().AddVariantSet("light")
    for name in ("off", "on"):
        variants.AddVariant(name)
    variants.SetVariantSelection("on")
    with variants.GetVariantEditContext():
        root.GetPayloads().AddPayload("./extra.usda", "/A")
    variants.SetVariantSelection("off")
    usd_stage.Save()
    found = inspect_usd(tmp_path / "a.usda")
    assert found.facts["layers"] == ["extra.usda"] and found.size_bytes == sum(p.stat().st_size for p in tmp_path.iterdir())
    assert any("/A" in sentence and "extra.usda" in sentence for sentence in found.errors)  # it has no such prim


def test_missing_files_are_named(tmp_path):
    write_asset(make_ball(), tmp_path / "ball.usdc", name="Ball")
    gone = next((tmp_path / "ball_textures").iterdir())
    gone.unlink()
    found = inspect_usd(tmp_path / "ball.usdc")
    assert any(gone.name in sentence for sentence in found.errors)
    textures = [part.facts for part in of_kind(found, "texture")]
    assert all(facts["file"].endswith(gone.name) is ("missing" in facts) is ("resolution" not in facts) for facts in textures)
    shutil.rmtree(tmp_path / "ball_layers")
    found = inspect_usd(tmp_path / "ball.usdc")
    assert found.facts["default_prim"] == "/Ball" and found.facts["extent_m"] is None
    assert any("payload.usda" in sentence for sentence in found.errors)


def repack(source, target, change):
    """A package with other entries: `change` takes and returns (name, data) and the method of compression."""
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(target, "w") as new:
        for entry in old.infolist():
            name, data, method = change(entry.filename, old.read(entry))
            new.writestr(zipfile.ZipInfo(name), data, method)


def test_packages_that_arkit_does_not_take(tmp_path):
    write_asset(make_ball(), tmp_path / "ball.usdz", name="Ball")
    repack(tmp_path / "ball.usdz", tmp_path / "zipped.usdz", lambda name, data: (name, data, zipfile.ZIP_DEFLATED))
    with pytest.raises(AssetError, match=r"zipped\.usdz.* compressed"):
        inspect_usd(tmp_path / "zipped.usdz")
    repack(tmp_path / "ball.usdz", tmp_path / "loose.usdz", lambda name, data: (name, data, zipfile.ZIP_STORED))
    assert any("ByteMisalignment" in sentence and "ball.usdc" in sentence for sentence in inspect_usd(tmp_path / "loose.usdz").errors)
    text = Sdf.Layer.FindOrOpen(str(tmp_path / "ball.usdz")).ExportToString().encode()
    repack(tmp_path / "ball.usdz", tmp_path / "text.usdz",
           lambda name, data: ("ball.usda", text, zipfile.ZIP_STORED) if name == "ball.usdc" else (name, data, zipfile.ZIP_STORED))
    assert any("ARKit takes a binary root layer" in sentence for sentence in inspect_usd(tmp_path / "text.usdz").warnings)
    write_asset(make_ball(), tmp_path / "layered.usdc", name="Ball")
    with zipfile.ZipFile(tmp_path / "layered.usdz", "w") as package:
        for file in ("layered.usdc", *(f"layered_layers/{name}" for name in LAYER_FILES)):
            package.write(tmp_path / file, file)
    assert any("refers to ./layered_layers/payload.usda" in sentence for sentence in inspect_usd(tmp_path / "layered.usdz").warnings)


def test_an_unknown_scale_is_a_note(tmp_path):
    for suffix in SUFFIXES:
        write_asset(make_wave("orthographic"), tmp_path / f"a{suffix}", name="a")
        assert inspect_usd(tmp_path / f"a{suffix}").facts["notes"]["relit:scale"].startswith("unknown")


@pytest.mark.parametrize(("name", "content", "words"), [
    ("a.usda", b"hello", "a.usda cannot be opened: it is no USD file, or a damaged one"),
    ("a.usdc", b"PXR-USDC", "a.usdc cannot be opened"),
    ("a.usdz", b"PK", "a.usdz is no USDZ package, or only a part of one"),
    ("a.obj", b"v 0 0 0", "a.obj: relit inspect reads .usda, "),
    ("none.usda", None, "none.usda is not there"),
    ("folder.usda", "folder", "folder.usda is a folder: give the asset"),
])
def test_what_is_no_asset_is_one_sentence(relit, tmp_path, name, content, words):
    if content == "folder":
        (tmp_path / name).mkdir()
    elif content is not None:
        (tmp_path / name).write_bytes(content)
    outcome = relit("inspect", tmp_path / name)
    assert (outcome.code, outcome.out) == (2, "") and words in outcome.err and outcome.err.count("\n") == 1


@pytest.mark.parametrize("part", [0.3, 0.9])
def test_half_a_package_is_one_sentence(part, tmp_path):
    write_asset(make_ball(), tmp_path / "ball.usdz", name="Ball")
    whole = (tmp_path / "ball.usdz").read_bytes()
    (tmp_path / "half.usdz").write_bytes(whole[:int(part * len(whole))])
    with pytest.raises(AssetError, match="only a part of one"):
        inspect_usd(tmp_path / "half.usdz")
    damaged = bytearray(whole)
    damaged[len(whole) // 2] ^= 0xFF
    (tmp_path / "damaged.usdz").write_bytes(damaged)
    with pytest.raises(AssetError, match="damaged"):
        inspect_usd(tmp_path / "damaged.usdz")


def test_the_command_prints_facts_or_json(relit, tmp_path):
    write_asset(make_ball(), tmp_path / "ball.usda", name="Ball")
    outcome = relit.done("inspect", tmp_path / "ball.usda")
    lines = outcome.out.splitlines()
    assert lines[0].startswith(f"asset        {tmp_path}/ball.usda, ") and {"default_prim /Ball", "kind         component"} < set(lines)
    assert "variants     geo (mesh), look (metallic, specular)" in lines and lines[-1] == "found        0 errors, 0 warnings"
    assert not any(line.startswith("wrong") for line in lines)
    outcome = relit("inspect", tmp_path / "ball.usda", "--json")
    found, plain = inspect_usd(tmp_path / "ball.usda"), json.loads(outcome.out)
    assert outcome.code == 0 and plain["parts"] == [part._asdict() for part in found.parts] and plain["facts"] == found.facts


def test_the_command_ends_with_what_is_wrong(relit, tmp_path):
    write_asset(make_ball(), tmp_path / "ball.usda", name="Ball")
    (tmp_path / "ball_layers" / "geometry.usdc").unlink()
    outcome = relit("inspect", tmp_path / "ball.usda")
    assert outcome.code == 2 and "geometry.usdc" in outcome.err and outcome.err.count("\n") == 1
    assert sum(line.startswith("wrong") for line in outcome.out.splitlines()) >= 2


@pytest.mark.parametrize("content", [
    "int[] faceVertexCounts = [5,-2]\nint[] faceVertexIndices = [0,1,2]",
    "normal3f[] normals = []",
    'color3f[] primvars:displayColor = [] (interpolation = "vertex")',
])
def test_odd_arrays_are_facts(content, tmp_path):
    """Counts below zero, and arrays without a value; no default prim is a finding of the validators."""
    (tmp_path / "a.usda").write_text('#usda 1.0\ndef Mesh "A"\n{\npoint3f[] points = [(0,0,0), (1,0,0), (0,1,0)]\n' f'{content}\n}}\n')
    found = inspect_usd(tmp_path / "a.usda")
    mesh, = of_kind(found, "mesh")
    assert mesh.facts["vertices"] == 3 and found.facts["default_prim"] is None
    assert any("defaultPrim" in sentence for sentence in found.errors)


@pytest.mark.parametrize(("corners", "errors"), [
    ("(-1,-1,-1)", 1), ("(-1,-1,-1), (1,1,1)", 0), ("(0,0,0), (1,1,1)", 1), ("(-1,-1,-1), (1,1,0), (0,0,0), (1,1,1)", 0),
])
def test_corners_of_an_extents_hint(corners, errors, tmp_path):
    """Two for each purpose."""
    (tmp_path / "a.usda").write_text('#usda 1.0\n(defaultPrim = "A")\ndef Xform "A" (prepend apiSchemas = ["GeomModelAPI"]) {\n'
                                     f'float3[] extentsHint = [{corners}]\ndef Sphere "S" {{ }}\n}}\n')
    assert len([error for error in inspect_usd(tmp_path / "a.usda").errors if "extentsHint" in error]) == errors


def test_a_shot_that_refers_to_a_package(ball, tmp_path):
    """Its textures lie in the package, which counts once."""
    write_asset(ball, tmp_path / "ball.usdz", name="Ball")
    (tmp_path / "shot.usda").write_text('#usda 1.0\n(defaultPrim = "A")\ndef Xform "A" (references = @./ball.usdz@) { }\n')
    found = inspect_usd(tmp_path / "shot.usda")
    assert found.size_bytes == sum((tmp_path / name).stat().st_size for name in ("shot.usda", "ball.usdz"))
    assert all("resolution" in part.facts for part in of_kind(found, "texture"))


FLAT = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]


def square(path, *, points=FLAT, indices=(0, 1, 2, 3), st=((0, 0), (1, 0), (1, 1), (0, 1)), texture=None):
    """A file with one face, as another program may write it."""
    usd_stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(usd_stage, "Y")
    UsdGeom.SetStageMetersPerUnit(usd_stage, 1)
    usd_stage.SetDefaultPrim(UsdGeom.Xform.Define(usd_stage, "/A").GetPrim())
    mesh = UsdGeom.Mesh.Define(usd_stage, "/A/M")
    mesh.CreatePointsAttr(points)
    mesh.CreateFaceVertexCountsAttr([4])
    mesh.CreateFaceVertexIndicesAttr(list(indices))
    mesh.CreateSubdivisionSchemeAttr("none")
    mesh.CreateExtentAttr([(0, 0, 0), (1, 1, 0)])
    UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, "vertex").Set(st)
    UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("sigma", Sdf.ValueTypeNames.FloatArray, "vertex").Set([1, 1, 1, float("nan")])  # not known
    if texture is not None:
        material, shader = UsdShade.Material.Define(usd_stage, "/A/Mat"), UsdShade.Shader.Define(usd_stage, "/A/Mat/S")
        image = UsdShade.Shader.Define(usd_stage, "/A/Mat/T")
        shader.CreateIdAttr("UsdPreviewSurface")
        image.CreateIdAttr("UsdUVTexture")
        image.CreateInput("file", Sdf.ValueTypeNames.Asset).Set(texture)
        image.CreateOutput("rgb", Sdf.ValueTypeNames.Float3)
        shader.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).ConnectToSource(image.ConnectableAPI(), "rgb")
        shader.CreateOutput("surface", Sdf.ValueTypeNames.Token)
        material.CreateSurfaceOutput().ConnectToSource(shader.ConnectableAPI(), "surface")
        UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material)
    usd_stage.GetRootLayer().Save()
    return inspect_usd(path).errors


@pytest.mark.parametrize("changes, sentence", [
    ({}, None),
    ({"points": [*FLAT[:3], (0, float("nan"), 0)]}, r"/A/M\.points: 1 of its 4 values are not finite"),
    ({"indices": (0, 1, 2, 7)}, "/A/M: its faces are wrong: .* 7"),
    ({"st": ((0, 0), (1, 0))}, r"/A/M\.primvars:st: has 2 values, and its interpolation needs 4"),
    ({"st": ((0, 0), (1, 0), (1, 1), (0, float("inf")))}, r"/A/M\.primvars:st: 1 of its 4 values are not finite"),
    ({"texture": "whole.png"}, None),
    ({"texture": "half.png"}, r"diffuseColor: half\.png is no image that can be read"),
    ({"texture": "text.png"}, r"diffuseColor: text\.png is no image that can be read"),
    ({"texture": ""}, "diffuseColor: the texture names no file"),
])
def test_faults_of_geometry_and_textures_are_errors(changes, sentence, tmp_path):
    write_png(tmp_path / "whole.png", np.random.default_rng(0).random((64, 64, 3), np.float32), srgb=True)
    data = (tmp_path / "whole.png").read_bytes()
    (tmp_path / "half.png").write_bytes(data[:len(data) // 2])
    (tmp_path / "text.png").write_text("no picture")
    errors = square(tmp_path / "a.usda", **changes)
    assert len(errors) == (sentence is not None) and all(re.search(str(sentence), error) for error in errors)


@pytest.mark.parametrize(("metres", "words"), [(1.0, None), (1000.0, "its metersPerUnit is 1000"), (1e-4, "its metersPerUnit is 0.0001")])
def test_sizes_of_another_unit_are_asked_about(ball, tmp_path, metres, words):
    path = tmp_path / "a.usda"
    write_asset(ball, path, name="a")
    UsdGeom.SetStageMetersPerUnit(opened := Usd.Stage.Open(str(path)), metres)
    opened.GetRootLayer().Save()
    found = [warning for warning in inspect_usd(path).warnings if "m large: " in warning]
    assert found == [] if words is None else words in found[0]
