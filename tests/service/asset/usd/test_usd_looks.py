"""What relit inspect says of USD assets that open, and look otherwise than they were meant: right ones are changed in one place."""

import re

import numpy as np
import pytest
from pxr import Usd, UsdGeom, UsdShade, Vt

from service.asset.usd.asset import write_asset
from service.asset.usd.inspect import inspect_usd
from stage.formats.images import write_png

MESH, MATERIAL = "/Kugel/Geom/Mesh", "/Kugel/Looks/Material"


def changed(ball, folder, change):
    """What is found of an asset of the ball after a change."""
    path = folder / "ball.usda"
    write_asset(ball, path, name="Kugel", version="v2")
    usd_stage = Usd.Stage.Open(str(path))
    change(usd_stage)
    usd_stage.GetRootLayer().Save()
    return inspect_usd(path)


def normals(scale):
    def change(usd_stage):
        attribute = UsdGeom.Mesh(usd_stage.GetPrimAtPath(MESH)).GetNormalsAttr()
        attribute.Set(Vt.Vec3fArray.FromNumpy(np.float32(scale) * np.asarray(attribute.Get())))
    return change


def reader(usd_stage):
    shaders = (UsdShade.Shader(prim) for prim in usd_stage.Traverse() if str(prim.GetPath()).startswith(f"{MATERIAL}/"))
    return next(each for each in shaders if each and each.GetIdAttr().Get() == "UsdPrimvarReader_float2")


def of_other_coordinates(usd_stage):
    for each in UsdShade.Utils.GetValueProducingAttributes(reader(usd_stage).GetInput("varname")):
        each.Set("UVMap")


def with_substitute(usd_stage):
    of_other_coordinates(usd_stage)
    reader(usd_stage).CreateInput("fallback", reader(usd_stage).GetOutput("result").GetTypeName()).Set((0.5, 0.5))


@pytest.mark.parametrize("change, sentence", [
    (normals(1), None),
    (normals(1.005), None),  # as halves or bytes may have it
    (normals(0.5), rf"{MESH}\.normals: (\d+) of its \1 values are not of length 1 but from 0\.5 to 0\.5 long"),
    (lambda stage: UsdGeom.PrimvarsAPI(stage.GetPrimAtPath(MESH)).GetPrimvar("st").GetAttr().Block(),
     f"{MESH}: has no primvar st, by which its material /Kugel/Looks/.* reads textures"),
    (of_other_coordinates, f"{MESH}: has no primvar UVMap, by which"),
    (with_substitute, None),
], ids=["unchanged", "rounded", "half", "no st", "other st", "substitute"])
def test_a_mesh_that_is_shown_otherwise_is_a_warning(ball, change, sentence, tmp_path):
    found = changed(ball, tmp_path, change)
    assert found.errors == ()
    assert bool(found.warnings) == (sentence is not None) and all(re.search(str(sentence), each) for each in found.warnings)


@pytest.mark.parametrize("factor, wrong", [(1, False), (100, True)])
def test_an_extent_that_the_points_do_not_fill_is_an_error(ball, factor, wrong, tmp_path):
    """As where a program takes centimetres for metres in one of both."""
    def change(usd_stage):
        attribute = UsdGeom.Mesh(usd_stage.GetPrimAtPath(MESH)).GetExtentAttr()
        attribute.Set([factor * corner for corner in attribute.Get()])

    errors = changed(ball, tmp_path, change).errors
    assert bool(errors) == wrong  # the extentsHint, which OpenUSD computes of the extent, is wrong too
    assert any(re.search(rf"{MESH}\.extent: is from \(.*\), and the geometry from \(", each) for each in errors) == wrong


@pytest.mark.parametrize("bits", [8, pytest.param(16, marks=pytest.mark.long)])
@pytest.mark.parametrize("entry, space, words", [
    ("diffuseColor", "sRGB", None), ("roughness", "raw", None),
    ("diffuseColor", "raw", "diffuseColor: .* is read as raw, and colours of 8 bits are mostly sRGB"),
    ("roughness", "sRGB", "roughness: .* is read as sRGB .*set it to raw"),
    ("roughness", "auto", "roughness: .* is read as sRGB .*set it to raw")])
def test_the_colour_space_of_a_texture_that_does_not_fit_its_input(ball, bits, entry, space, words, tmp_path):
    """`auto` is sRGB for three channels of 8 bits, and raw for 16; 16 bits that are raw may be colours."""
    def change(usd_stage):
        surface = UsdShade.Material(usd_stage.GetPrimAtPath(MATERIAL)).ComputeSurfaceSource()[0]
        source, = UsdShade.Utils.GetValueProducingAttributes(surface.GetInput(entry))
        texture = UsdShade.Shader(source.GetPrim())
        write_png(tmp_path / "other.png", np.full((8, 8, 3), 99, f"uint{bits}"), srgb=True)
        texture.GetInput("file").Set("./other.png")
        texture.GetInput("sourceColorSpace").Set(space)

    warnings = changed(ball, tmp_path, change).warnings
    told = words is not None and (bits == 8 or space == "sRGB")
    assert bool(warnings) == told and all(re.search(str(words), each) for each in warnings)
