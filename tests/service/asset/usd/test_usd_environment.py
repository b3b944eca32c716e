"""An environment as a dome light: its map in linear Rec.709, oriented as it was."""

import numpy as np
import pytest
from pxr import Usd, UsdGeom, UsdLux

from stage.colour.colour import rgb_matrix
from stage.formats import exr
from tests.scenes.surfaces import make_wave

RADIANCE = np.random.default_rng(5).random((8, 16, 3)).astype(np.float32)


def write_map(path, radiance=RADIANCE, space="lin_rec709_scene"):
    exr.write(path, {name: radiance[..., index] for index, name in enumerate("RGB")}, color_space=space, metadata={})
    return path


def export(relit, tmp_path, environment, suffix=".usda"):
    make_wave("orthographic", pixel_size_m=0.01).write(tmp_path / "maps.exr")
    return relit("export", tmp_path / "maps.exr", "--out", tmp_path / f"a{suffix}", "--name", "A", "--environment", environment)


@pytest.mark.parametrize("suffix", [".usda", ".usdc", ".usdz"])
def test_a_dome_light_has_the_map(suffix, relit, tmp_path):
    outcome = export(relit, tmp_path, write_map(tmp_path / "sky.exr"), suffix)
    assert outcome.code == 0 and f"lights   {tmp_path / 'a_lights' / 'environment.usda'}\n" in outcome.out
    usd_stage = Usd.Stage.Open(str(tmp_path / f"a{suffix}"))
    assert not any(prim.HasAPI(UsdLux.LightAPI) for prim in usd_stage.Traverse())
    provenance = usd_stage.GetRootLayer().customLayerData["relit"]
    if suffix == ".usdz":  # ARKit knows no lights: they lie beside the package
        usd_stage = Usd.Stage.Open(str(tmp_path / "a_lights" / "environment.usda"))
    else:
        usd_stage.GetDefaultPrim().GetVariantSet("light").SetVariantSelection("environment")
    dome = UsdLux.DomeLight(usd_stage.GetPrimAtPath("/A/Environment"))
    assert dome.GetIntensityAttr().Get() == 1 and dome.GetTextureFormatAttr().Get() == "latlong"
    assert not UsdGeom.Xformable(dome).GetOrderedXformOps()  # UsdLux orients the map as relit does
    file = dome.GetTextureFileAttr()
    assert file.GetColorSpace() == "lin_rec709_scene" and file.Get().resolvedPath
    channels, metadata = exr.read(file.Get().resolvedPath)
    np.testing.assert_allclose(np.stack([channels[name] for name in "RGB"], axis=-1), RADIANCE, atol=3e-4)  # half
    assert metadata["colorInteropID"] == "lin_rec709_scene" and provenance["environment"]


def test_other_primaries_are_converted_and_a_bright_sun_is_kept(relit, tmp_path):
    radiance = RADIANCE.copy()
    radiance[2, 3] = 2e5  # above the largest half
    assert export(relit, tmp_path, write_map(tmp_path / "sky.exr", radiance, "lin_ap1_scene")).code == 0
    channels, _ = exr.read(tmp_path / "a_lights" / "environment.exr")
    wanted = np.maximum(radiance @ rgb_matrix("lin_ap1_scene", "lin_rec709_scene").T, 0)
    np.testing.assert_allclose(np.stack([channels[name] for name in "RGB"], axis=-1), wanted, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize(("radiance", "fault"), [
    (RADIANCE[:, :12], "a lat-long map is twice as wide as high"),
    (np.where(RADIANCE > 0.9, np.nan, RADIANCE), "not finite (NaN or infinity)"),
    (RADIANCE - 0.5, "negative"),
], ids=["not 2:1", "NaN", "negative"])
def test_a_bad_map_is_refused(radiance, fault, relit, tmp_path):
    outcome = export(relit, tmp_path, write_map(tmp_path / "sky.exr", radiance))
    assert outcome.code == 2 and fault in outcome.err and "sky.exr" in outcome.err
    assert {file.name for file in tmp_path.iterdir()} == {"maps.exr", "sky.exr"}
