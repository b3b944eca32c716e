"""Cards of relit frames and environments beside USD assets."""

import numpy as np
import OpenImageIO as oiio
import pytest
from pxr import Usd, UsdGeom, UsdLux, UsdShade

from service.asset.content.card import find_frames
from service.asset.usd.asset import write_asset
from service.asset.usd.surroundings import Surroundings
from stage.capture.camera import Distortion
from stage.colour.colour import rgb_matrix
from stage.formats import exr
from tests.clients.validators import findings
from tests.scenes.captures import write_radiance
from tests.scenes.surfaces import make_wave
from tests.scenes.surroundings import COVERAGE, write_frames
from tests.service.asset.usd.test_usd_rig import pixels_of_vertices

POSE = ((0.0, 0.0, 1.0, 0.3), (1.0, 0.0, 0.0, -0.1), (0.0, 1.0, 0.0, 2.0), (0.0, 0.0, 0.0, 1.0))
RADIANCE = np.random.default_rng(5).random((8, 16, 3)).astype(np.float32)


def export(tmp_path, maps, suffix=".usda", numbers=(3, 4), **frames):
    pattern = write_frames(tmp_path / "frames", numbers, maps.camera, **frames)
    report = write_asset(maps, tmp_path / f"a{suffix}", name="A", surroundings=Surroundings(card=find_frames(pattern, maps.camera)))
    usd_stage = Usd.Stage.Open(str(tmp_path / f"a{suffix}"))
    usd_stage.GetDefaultPrim().GetVariantSet("geo").SetVariantSelection("card")
    return usd_stage, report


def texture(usd_stage, name):
    return UsdShade.Shader(usd_stage.GetPrimAtPath(f"/A/Looks/Card/{name}"))


def file_at(usd_stage, name, time):
    return texture(usd_stage, name).GetInput("file").Get(time).resolvedPath


@pytest.mark.parametrize("maps", [make_wave("perspective", world_from_camera=POSE), make_wave("orthographic", pixel_size_m=0.01),
                                  make_wave("orthographic")], ids=["perspective", "orthographic", "no scale"])
def test_the_card_fills_the_picture_of_the_camera(maps, tmp_path):
    usd_stage, _ = export(tmp_path, maps)
    assert [prim.GetPath().pathString for prim in usd_stage.Traverse() if prim.IsA(UsdGeom.Mesh)] == ["/A/Geom/Card"]
    card = UsdGeom.Mesh(usd_stage.GetPrimAtPath("/A/Geom/Card"))
    shown, _ = pixels_of_vertices(usd_stage, "Camera", (1, 1), "Card")
    s, t = np.array(UsdGeom.PrimvarsAPI(card).GetPrimvar("st").Get()).T
    np.testing.assert_allclose(shown, np.column_stack([s, 1 - t]), atol=1e-5)  # float32 apertures
    points = np.array(card.GetPointsAttr().Get(), dtype=np.float64)
    a, b, c = (points[index] for index in list(card.GetFaceVertexIndicesAttr().Get())[:3])
    assert np.cross(b - a, c - b)[2] > 0  # towards the camera


def test_a_card_bends_as_the_lens_does(tmp_path):
    maps = make_wave("perspective", distortion=Distortion(model="brown_conrady", k=(0.4, 0.1, 0.0), p=(0.01, 0.02)))
    usd_stage, _ = export(tmp_path, maps)
    card = UsdGeom.Mesh(usd_stage.GetPrimAtPath("/A/Geom/Card"))
    points = np.array(card.GetPointsAttr().Get(), dtype=np.float64)
    st = np.array(UsdGeom.PrimvarsAPI(card).GetPrimvar("st").Get())
    camera = maps.camera
    x, down = camera.distortion.apply(points[:, 0] / -points[:, 2], points[:, 1] / points[:, 2])
    found = np.column_stack([camera.focal_px[0] * x + camera.principal_px[0], camera.focal_px[1] * down + camera.principal_px[1]])
    np.testing.assert_allclose(found, np.column_stack([st[:, 0] * camera.width, (1 - st[:, 1]) * camera.height]), atol=1e-4)  # float32


@pytest.mark.parametrize("space", ["lin_rec709_scene", "lin_ap1_scene"])
def test_exr_frames_keep_their_colours_without_the_coverage(space, tmp_path):
    usd_stage, report = export(tmp_path, make_wave("orthographic"), space=space)
    assert (usd_stage.GetStartTimeCode(), usd_stage.GetEndTimeCode()) == (3, 4) and report.clipped_pixels["card"] == 0
    file = texture(usd_stage, "EmissiveColor").GetInput("file")
    assert file.GetAttr().GetColorSpace() == "lin_rec709_scene" and file.GetAttr().GetTimeSamples() == [3, 4]
    assert texture(usd_stage, "EmissiveColor").GetInput("sourceColorSpace").Get() == "raw"
    for number in (3, 4):
        wanted = rgb_matrix(space, "lin_rec709_scene") @ [number / 4, 0.5, 2.0] if space != "lin_rec709_scene" else [number / 4, 0.5, 2.0]
        channels, _ = exr.read(file_at(usd_stage, "EmissiveColor", number))
        assert set(channels) == set("RGB")
        for name, value in zip("RGB", wanted, strict=True):  # bled over where nothing is covered
            np.testing.assert_allclose(channels[name], value, rtol=2e-3)  # half, of a product of two halves
        opacity = oiio.ImageBuf(file_at(usd_stage, "Opacity", number)).get_pixels(oiio.FLOAT)
        np.testing.assert_allclose(opacity[0, :3, 0], COVERAGE, atol=1e-5)  # 16 bits


def test_a_package_holds_them_as_png_and_counts_what_is_clipped(tmp_path):
    maps = make_wave("orthographic")
    usd_stage, report = export(tmp_path, maps, ".usdz", numbers=(7,))
    assert report.clipped_pixels["card"] == maps.camera.width * maps.camera.height * 2 // 3  # those that are covered: 2 is above 1
    file = texture(usd_stage, "EmissiveColor").GetInput("file")
    assert file.Get().path.endswith("card.0007.png") and file.GetAttr().GetNumTimeSamples() == 0
    assert texture(usd_stage, "EmissiveColor").GetInput("sourceColorSpace").Get() == "sRGB"


def test_frames_that_cover_everything_have_no_opacity(tmp_path):
    usd_stage, _ = export(tmp_path, make_wave("orthographic"), opaque=True)
    assert not usd_stage.GetPrimAtPath("/A/Looks/Card/Opacity")
    assert not list((tmp_path / "a_textures").glob("card_opacity*"))


def test_a_second_export_leaves_no_older_frames(tmp_path):
    maps = make_wave("orthographic")
    export(tmp_path, maps, numbers=(1, 2))
    mine = tmp_path / "a_textures" / "card.notes.txt"
    mine.write_text("mine")
    pattern = write_frames(tmp_path / "other", (9,), maps.camera)
    write_asset(maps, tmp_path / "a.usda", name="A", surroundings=Surroundings(card=find_frames(pattern, maps.camera)))
    assert sorted(file.name for file in (tmp_path / "a_textures").glob("card*")) == ["card.0009.exr", "card.notes.txt",
                                                                                     "card_opacity.0009.png"]


@pytest.mark.parametrize("suffix", [".usda", ".usdz"])
def test_the_validators_find_nothing(suffix, tmp_path):
    export(tmp_path, make_wave("perspective"), suffix)
    assert findings(tmp_path / f"a{suffix}") == []


def test_frames_that_cannot_be_shown_are_refused(relit, tmp_path):
    maps = make_wave("orthographic", pixel_size_m=0.01)
    maps.write(tmp_path / "maps.exr")
    pattern = write_frames(tmp_path / "frames", (1, 2, 5), maps.camera)
    small = write_frames(tmp_path / "small", (1,), maps.camera.model_copy(update={"resolution": (4, 4)}))
    broken = write_frames(tmp_path / "broken", (1,), maps.camera)
    channels, _ = exr.read(tmp_path / "broken" / "frame.0001.exr")
    channels["G"] = np.full_like(channels["G"], np.nan)
    exr.write(tmp_path / "broken" / "frame.0001.exr", channels, color_space="lin_rec709_scene", metadata={})
    exr.write(tmp_path / "grey.exr", {"Y": channels["R"]}, color_space="lin_rec709_scene", metadata={})
    faults = {pattern: "frame 3 and 1 more is missing between 1 and 5", small: "is 4x4, camera.resolution says 30x20",
              broken: "pixels are not finite", tmp_path / "grey.exr": "has no channels R, G and B",
              tmp_path / "none.####.exr": "there is no such frame", tmp_path / "none.exr": "is neither a frame nor a file name"}
    for card, fault in faults.items():
        assert fault in relit.refused("export", tmp_path / "maps.exr", "--out", tmp_path / "out" / "a.usda", "--card", card)
        assert not (tmp_path / "out").exists() or not list((tmp_path / "out").iterdir())


@pytest.mark.parametrize(("option", "out"), [("--card", "a.glb"), ("--environment", "a.glb"), ("--rig", "a.glb")])
def test_gltf_has_no_place_for_lights_and_frames(option, out, relit, tmp_path):
    make_wave("orthographic", pixel_size_m=0.01).write(tmp_path / "maps.exr")
    outcome = relit("export", tmp_path / "maps.exr", "--out", tmp_path / out, option, tmp_path)
    assert outcome.code == 2 and f"{option}: lights and frames go with solved maps" in outcome.err


def write_map(path, radiance=RADIANCE, space="lin_rec709_scene"):
    exr.write(path, {name: radiance[..., index] for index, name in enumerate("RGB")}, color_space=space, metadata={})
    return path


def export_with_environment(relit, tmp_path, environment, suffix=".usda"):
    make_wave("orthographic", pixel_size_m=0.01).write(tmp_path / "maps.exr")
    return relit("export", tmp_path / "maps.exr", "--out", tmp_path / f"a{suffix}", "--name", "A", "--environment", environment)


@pytest.mark.parametrize("suffix", [".usda", ".usdc", ".usdz"])
def test_a_dome_light_has_the_map(suffix, relit, tmp_path):
    outcome = export_with_environment(relit, tmp_path, write_map(tmp_path / "sky.exr"), suffix)
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


def test_a_map_whose_header_says_another_encoding_is_named(relit, tmp_path):
    sky = write_radiance(tmp_path / "sky.hdr", RADIANCE, "GAMMA=2.2", "EXPOSURE=4")
    told = export_with_environment(relit, tmp_path, sky).out
    assert "its header says GAMMA=2.2" in told and "multiplied by 4 (EXPOSURE)" in told


def test_other_primaries_are_converted_and_a_bright_sun_is_kept(relit, tmp_path):
    radiance = RADIANCE.copy()
    radiance[2, 3] = 2e5  # above the largest half
    assert export_with_environment(relit, tmp_path, write_map(tmp_path / "sky.exr", radiance, "lin_ap1_scene")).code == 0
    channels, _ = exr.read(tmp_path / "a_lights" / "environment.exr")
    wanted = np.maximum(radiance @ rgb_matrix("lin_ap1_scene", "lin_rec709_scene").T, 0)
    np.testing.assert_allclose(np.stack([channels[name] for name in "RGB"], axis=-1), wanted, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize(("radiance", "fault"), [
    (RADIANCE[:, :12], "a lat-long map is twice as wide as high"),
    (np.where(RADIANCE > 0.9, np.nan, RADIANCE), "not finite (NaN or infinity)"),
    (RADIANCE - 0.5, "negative"),
], ids=["not 2:1", "NaN", "negative"])
def test_a_bad_map_is_refused(radiance, fault, relit, tmp_path):
    outcome = export_with_environment(relit, tmp_path, write_map(tmp_path / "sky.exr", radiance))
    assert outcome.code == 2 and fault in outcome.err and "sky.exr" in outcome.err
    assert {file.name for file in tmp_path.iterdir()} == {"maps.exr", "sky.exr"}
