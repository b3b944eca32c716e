"""The light stage and the camera of a USD asset."""

import dataclasses
import zipfile

import numpy as np
import pytest
from pxr import Gf, Usd, UsdGeom, UsdLux

from service.asset.content.mesh import height_mesh
from service.asset.usd.asset import write_asset
from service.asset.usd.scene import PARALLAX_PX
from service.asset.usd.surroundings import Surroundings
from service.errors import AssetError
from stage.colour.colour import rgb_matrix
from stage.formats import exr
from tests.clients.validators import findings
from tests.scenes.surfaces import make_ball, make_wave
from tests.scenes.surroundings import capture_of

POSE = ((0.0, 0.0, 1.0, 0.3), (1.0, 0.0, 0.0, -0.1), (0.0, 1.0, 0.0, 2.0), (0.0, 0.0, 0.0, 1.0))
TILTED = np.array([0.6, 0.0, 0.8])
SCENES = {
    "centred": make_ball(), "no scale": make_wave("orthographic"),
    "posed": make_wave("orthographic", pixel_size_m=0.01, world_from_camera=POSE),
    "posed without scale": make_wave("orthographic", world_from_camera=POSE), "perspective": make_wave("perspective"),
    "perspective posed": make_wave("perspective", world_from_camera=POSE), "no depth": make_wave("perspective", surface_z_m=None),
}


def cap(half_angle_deg, count=4000):
    """A disc of sky around TILTED, as samples of equal solid angle."""
    top = np.cos(np.radians(half_angle_deg))
    z = 1 - (np.arange(count) + 0.5) / count * (1 - top)
    azimuth = np.pi * (1 + 5**0.5) * np.arange(count)
    across = np.cross(TILTED, [0.0, 1.0, 0.0])
    r = np.sqrt(1 - z * z)[:, None]
    directions = z[:, None] * TILTED + r * (np.cos(azimuth)[:, None] * across + np.sin(azimuth)[:, None] * np.array([0.0, 1.0, 0.0]))
    return {"type": "extended", "directions": directions.tolist(), "radiance": [[2.0, 1.0, 1.0]] * count,
            "solid_angle": [2 * np.pi * (1 - top) / count] * count}


def export(tmp_path, lights, suffix=".usda", projection="perspective", camera_changes=None, **changes):
    maps = make_wave(projection, world_from_camera=POSE, **(camera_changes or {}))
    capture = capture_of(tmp_path / "capture", maps.camera, lights, **changes)
    write_asset(maps, tmp_path / f"a{suffix}", name="A", surroundings=Surroundings(rig=capture))
    return open_rig(tmp_path / f"a{suffix}")


def open_rig(path):
    if path.suffix == ".usdz":  # ARKit knows no lights: they lie beside the package
        return Usd.Stage.Open(str(path.parent / "a_lights" / "rig.usda"))
    usd_stage = Usd.Stage.Open(str(path))
    usd_stage.GetDefaultPrim().GetVariantSet("light").SetVariantSelection("rig")
    return usd_stage


def irradiance(prim, point, time):
    """Direction to the light times irradiance, [3, RGB], of a surface that faces it, by the definitions of UsdLux."""
    light = UsdLux.LightAPI(prim)
    assert light.GetNormalizeAttr().Get()
    colour = np.array(light.GetColorAttr().Get()) * light.GetIntensityAttr().Get(time)
    world = UsdGeom.XformCache(time).GetLocalToWorldTransform(prim)
    backwards = np.array(world.TransformDir(Gf.Vec3d(0, 0, 1)))
    if prim.IsA(UsdLux.DistantLight):  # the normalised intensity of a distant light is its illuminance
        return np.outer(backwards, colour)
    way = np.array(world.ExtractTranslation()) - point
    distance = np.linalg.norm(way)
    radius = UsdLux.SphereLight(prim).GetRadiusAttr().Get()
    radiance = colour / (4 * np.pi * radius**2)
    focus = UsdLux.ShapingAPI(prim).GetShapingFocusAttr().Get() or 0.0
    shaped = max(way @ backwards / distance, 0) ** focus
    return np.outer(way / distance, np.pi * radius**2 / distance**2 * radiance * shaped)


def in_world(vector):
    return np.array(POSE)[:3, :3] @ vector


@pytest.mark.parametrize("suffix", [".usda", ".usdc", ".usdz"])
def test_each_light_gives_the_irradiance_of_the_manifest_at_its_own_frame(suffix, tmp_path):
    lights = [{"type": "distant", "direction": [0.1, -0.4, 0.9], "irradiance": [3, 2, 1]},
              {"type": "off"},
              {"type": "point", "position_m": [0.3, 0.2, -0.1], "intensity": [0.5, 0.25, 0.125]},
              {"type": "point", "position_m": [-0.2, 0.1, 0.2], "intensity": [1, 1, 1], "axis": [0.2, 0.1, -1], "anisotropy": 3},
              {"type": "full"}]
    usd_stage = export(tmp_path, lights, suffix)
    prims = [prim for prim in usd_stage.Traverse() if prim.HasAPI(UsdLux.LightAPI)]
    assert [prim.GetName() for prim in prims] == ["Light_0001", "Light_0003", "Light_0004"]
    assert (usd_stage.GetStartTimeCode(), usd_stage.GetEndTimeCode(), usd_stage.GetTimeCodesPerSecond()) == (1, 5, 24)
    point_m = np.array([0.02, -0.03, -0.9])
    direction = np.array([0.1, -0.4, 0.9]) / np.linalg.norm([0.1, -0.4, 0.9])
    expected = [np.outer(direction, [3, 2, 1])]
    for light in lights[2:4]:
        way = np.array(light["position_m"]) - point_m
        distance = np.linalg.norm(way)
        axis = np.array(light.get("axis", -way)) / np.linalg.norm(light.get("axis", way))
        cosine = -(way / distance) @ axis
        expected.append(np.outer(way / distance, np.array(light["intensity"]) * cosine ** light.get("anisotropy", 0) / distance**2))
    frames = [1, 3, 4]
    point = in_world(point_m) + np.array(POSE)[:3, 3]
    for own, prim, wanted in zip(frames, prims, expected, strict=True):
        for time in range(1, 6):
            lit = time in (own, 5)  # all lights are on in the tracking frame
            np.testing.assert_allclose(irradiance(prim, point, time), in_world(wanted) * lit, atol=2e-6 * np.abs(wanted).max())  # float32
        np.testing.assert_allclose(irradiance(prim, point, Usd.TimeCode.Default()), in_world(wanted), atol=2e-6 * np.abs(wanted).max())


def test_an_extended_light_has_the_vector_irradiance_and_the_angle_of_its_samples(tmp_path):
    usd_stage = export(tmp_path, [cap(25)])
    prim = usd_stage.GetPrimAtPath("/A/Rig/Light_0001")
    assert UsdLux.DistantLight(prim).GetAngleAttr().Get() == pytest.approx(50, abs=0.05)  # 4000 samples are no disc
    uniform = np.pi * np.sin(np.radians(25)) ** 2  # of radiance 1 over the disc, on a surface that faces it
    np.testing.assert_allclose(irradiance(prim, np.zeros(3), 1), in_world(np.outer(TILTED, [2 * uniform, uniform, uniform])),
                               atol=1e-3 * uniform)


def test_gradients_and_environments_are_domes(tmp_path):
    rng = np.random.default_rng(3)
    radiance = rng.random((8, 16, 3)).astype(np.float32)
    (tmp_path / "capture").mkdir()
    exr.write(tmp_path / "capture" / "sky.exr", {name: radiance[..., i] for i, name in enumerate("RGB")}, color_space="lin_rec709_scene",
              metadata={})
    usd_stage = export(tmp_path, [{"type": "gradient", "axis": "x", "sign": -1, "polarization": "cross"},
                                  {"type": "gradient", "axis": "full"}, {"type": "full"}, {"type": "environment", "image": "sky.exr"}])
    gradient, full, sky = [UsdLux.DomeLight(usd_stage.GetPrimAtPath(f"/A/Rig/Light_{number:04d}")) for number in (1, 2, 4)]
    assert gradient.GetPrim().GetCustomDataByKey("relit:polarization") == "cross"
    assert [full.GetIntensityAttr().Get(time) for time in (1, 2, 3, 4)] == [0, 1, 1, 0] and not full.GetTextureFileAttr().Get()
    pixels = exr.read(gradient.GetTextureFileAttr().Get().resolvedPath)[0]["R"]
    rows, cols = pixels.shape
    u = (np.arange(cols) + 0.5) / cols
    np.testing.assert_allclose(pixels[rows // 2], (1 - np.sin(2 * np.pi * u)) / 2, atol=2e-3)  # a quarter from the left is +x
    np.testing.assert_allclose(exr.read(sky.GetTextureFileAttr().Get().resolvedPath)[0]["G"], radiance[..., 1], atol=5e-4)  # half


def test_colours_are_rec709_whatever_the_capture_has(tmp_path):
    usd_stage = export(tmp_path, [{"type": "distant", "direction": [0, 0, 1], "irradiance": [2, 1, 0.5]}], color_space="lin_ap1_scene")
    light = UsdLux.LightAPI(usd_stage.GetPrimAtPath("/A/Rig/Light_0001"))
    found = np.array(light.GetColorAttr().Get()) * light.GetIntensityAttr().Get()
    np.testing.assert_allclose(found, np.maximum(rgb_matrix("lin_ap1_scene", "lin_rec709_scene") @ [2, 1, 0.5], 0), rtol=1e-5)


@pytest.mark.parametrize("suffix", [".usda", ".usdc"])
def test_lights_are_off_unless_they_are_selected(suffix, tmp_path):
    export(tmp_path, [{"type": "distant", "direction": [0, 0, 1], "irradiance": [1, 1, 1]}], suffix)
    usd_stage = Usd.Stage.Open(str(tmp_path / f"a{suffix}"))
    variants = usd_stage.GetDefaultPrim().GetVariantSet("light")
    assert variants.GetVariantSelection() == "off" and set(variants.GetVariantNames()) == {"off", "rig"}
    assert not any(prim.HasAPI(UsdLux.LightAPI) for prim in usd_stage.Traverse())


def test_a_package_holds_no_lights(tmp_path):
    export(tmp_path, [{"type": "gradient", "axis": "x", "sign": 1}], ".usdz")
    usd_stage = Usd.Stage.Open(str(tmp_path / "a.usdz"))
    assert "light" not in usd_stage.GetDefaultPrim().GetVariantSets().GetNames() and not usd_stage.HasAuthoredTimeCodeRange()
    assert not [name for name in zipfile.ZipFile(tmp_path / "a.usdz").namelist() if name.endswith((".exr", ".usda"))]
    (tmp_path / "a_lights" / "mine.txt").write_text("mine")
    maps = make_wave("perspective", world_from_camera=POSE)
    environment = tmp_path / "a_lights" / "rig_0001.exr"
    write_asset(maps, tmp_path / "a.usdz", name="A", surroundings=Surroundings(environment=environment))  # the rig stays
    assert {file.name for file in (tmp_path / "a_lights").iterdir()} == {"rig.usda", "rig_0001.exr", "environment.usda", "environment.exr",
                                                                         "mine.txt"}
    write_asset(maps, tmp_path / "a.usda", name="A", surroundings=Surroundings(environment=environment))  # replaces the lights
    assert {file.name for file in (tmp_path / "a_lights").iterdir()} == {"environment.usda", "environment.exr", "mine.txt"}


def test_the_layer_of_the_rig_stands_in_the_same_place_without_the_asset(tmp_path):
    within = export(tmp_path, [{"type": "point", "position_m": [0.3, 0.2, -0.1], "intensity": [1, 1, 1]}])
    alone = Usd.Stage.Open(str(tmp_path / "a_lights" / "rig.usda"))
    places = [UsdGeom.XformCache().GetLocalToWorldTransform(usd_stage.GetPrimAtPath("/A/Rig/Light_0001")) for usd_stage in (within, alone)]
    assert places[0] == places[1] and alone.GetEndTimeCode() == 1


@pytest.mark.parametrize("suffix", [".usda", ".usdz"])
def test_the_validators_find_nothing(suffix, tmp_path):
    lamp = {"type": "point", "position_m": [0.3, 0.2, -0.1], "intensity": [1, 1, 1], "axis": [0, 0, -1], "anisotropy": 2}
    export(tmp_path, [{"type": "distant", "direction": [0, 0, 1], "irradiance": [1, 1, 1]}, cap(10, 50), lamp,
                      {"type": "gradient", "axis": "y", "sign": 1}], suffix)
    assert [found for file in (tmp_path / f"a{suffix}", tmp_path / "a_lights" / "rig.usda") for found in findings(file)] == []


def test_what_is_no_rig_is_refused(relit, tmp_path):
    maps = make_wave("orthographic", pixel_size_m=None)
    maps.write(tmp_path / "maps.exr")
    whole = {"type": "extended", "directions": [[1, 0, 0], [-1, 0, 0], [0, 0, 1], [0, 0, -1]], "radiance": [[1, 1, 1]] * 4,
             "solid_angle": [3.14] * 4}
    faults = {"surrounds the object": [whole], "gives no scale": [{"type": "point", "position_m": [0, 0, 1], "intensity": [1, 1, 1]}],
              "none is lit by a light whose place is known": [{"type": "off"}, {"type": "full"}]}
    for index, (fault, lights) in enumerate(faults.items()):
        capture = capture_of(tmp_path / f"capture{index}", maps.camera, lights)
        assert fault in relit.refused("export", tmp_path / "maps.exr", "--out", tmp_path / "a.usda", "--rig", capture.folder)
    other = capture_of(tmp_path / "other", maps.camera.model_copy(update={"principal_px": (1.0, 2.0)}), [{"type": "off"}])
    outcome = relit("export", tmp_path / "maps.exr", "--out", tmp_path / "a.usda", "--rig", other.folder)
    assert outcome.code == 2 and "its camera differs from that of the maps in principal_px" in outcome.err
    assert {file.name for file in tmp_path.iterdir()} == {"maps.exr", "capture0", "capture1", "capture2", "other"}


def test_lights_of_a_package_do_not_replace_those_of_a_layer(tmp_path):
    export(tmp_path, [{"type": "gradient", "axis": "x", "sign": 1}], ".usda")
    before = (tmp_path / "a_lights" / "rig.usda").read_bytes()
    maps = make_wave("perspective")
    other = capture_of(tmp_path / "other", maps.camera, [{"type": "distant", "direction": [0, 0, 1], "irradiance": [1, 1, 1]}])
    with pytest.raises(AssetError, match=r"a\.usdz: its lights would replace those of .*a\.usda: choose"):
        write_asset(maps, tmp_path / "a.usdz", name="A", surroundings=Surroundings(rig=other))
    assert (tmp_path / "a_lights" / "rig.usda").read_bytes() == before and not (tmp_path / "a.usdz").exists()
    write_asset(maps, tmp_path / "a.usdz", name="A")  # without lights it has no use for the folder


@pytest.mark.parametrize("suffix", [".usda", ".usdz"])
def test_the_layer_of_lights_is_a_library_that_mixers_read(suffix, tmp_path):
    lights = [{"type": "distant", "direction": [0, 0, 1], "irradiance": [1, 2, 3]}, {"type": "off"},
              {"type": "gradient", "axis": "x", "sign": 1}]
    export(tmp_path, lights, suffix)
    usd_stage = Usd.Stage.Open(str(tmp_path / "a_lights" / "rig.usda"))
    root = usd_stage.GetDefaultPrim()
    assert (UsdGeom.GetStageUpAxis(usd_stage), UsdGeom.GetStageMetersPerUnit(usd_stage)) == (UsdGeom.Tokens.y, 1.0)
    assert Usd.ModelAPI(root).GetKind() == "component" and root.IsModel()
    found = [prim.GetPath() for prim in usd_stage.Traverse() if prim.HasAPI(UsdLux.LightAPI)]
    assert [path.name for path in found] == ["Light_0001", "Light_0003"]
    assert UsdLux.LightListAPI(root).ComputeLightList(UsdLux.LightListAPI.ComputeModeConsultModelHierarchyCache) == found
    [collection] = Usd.CollectionAPI.GetAll(root)
    members = Usd.CollectionAPI.ComputeIncludedObjects(collection.ComputeMembershipQuery(), usd_stage)
    assert [member.GetPath() for member in members] == found
    for path in found:
        light = UsdLux.LightAPI(usd_stage.GetPrimAtPath(path))
        assert light.GetExposureAttr().Get() == 0 and light.GetExposureAttr().GetNumTimeSamples() == 0
        assert light.GetIntensityAttr().IsAuthored() and light.GetColorAttr().GetNumTimeSamples() == 0
        assert light.GetPrim().GetAttribute("inputs:karma:light:lpetag").Get() == path.name


def pixels_of_vertices(usd_stage, name, resolution, mesh="Mesh"):
    """Where OpenUSD's frustum of a camera shows the vertices, [n, 2] pixels, and their depths between its planes, -1…1."""
    frustum = UsdGeom.Camera(usd_stage.GetPrimAtPath(f"/A/{name}")).GetCamera(Usd.TimeCode.Default()).frustum
    usd_mesh = UsdGeom.Mesh(usd_stage.GetPrimAtPath(f"/A/Geom/{mesh}"))
    to_world = UsdGeom.XformCache().GetLocalToWorldTransform(usd_mesh.GetPrim())
    to_clip = np.array(to_world * frustum.ComputeViewMatrix() * frustum.ComputeProjectionMatrix())  # row vectors
    points = np.array(usd_mesh.GetPointsAttr().Get(), dtype=np.float64)
    clip = np.column_stack([points, np.ones(len(points))]) @ to_clip
    x, y, depth = (clip[:, :3] / clip[:, 3:]).T
    return np.column_stack([(x + 1) / 2, (1 - y) / 2]) * resolution, depth


@pytest.mark.parametrize("scene", SCENES)
def test_vertices_project_onto_their_pixels(scene, tmp_path):
    """Also by the far perspective camera that stands in for an orthographic one."""
    maps = SCENES[scene]
    write_asset(maps, tmp_path / "a.usdc", name="A")
    usd_stage = Usd.Stage.Open(str(tmp_path / "a.usdc"))
    shown, depth = pixels_of_vertices(usd_stage, "Camera", maps.camera.resolution)
    wanted = np.column_stack([height_mesh(maps).st[:, 0], 1 - height_mesh(maps).st[:, 1]]) * maps.camera.resolution
    np.testing.assert_allclose(shown, wanted, atol=1e-3)  # apertures and points are float32
    assert depth.min() > -1 and depth.max() < 1  # nothing is clipped away
    if maps.camera.projection == "perspective":
        assert not usd_stage.GetPrimAtPath("/A/CameraPerspective")
        return
    assert UsdGeom.Camera(usd_stage.GetPrimAtPath("/A/CameraPerspective")).GetProjectionAttr().Get() == "perspective"
    shown, depth = pixels_of_vertices(usd_stage, "CameraPerspective", maps.camera.resolution)
    assert np.linalg.norm(shown - wanted, axis=1).max() < PARALLAX_PX * 1.05  # float32 of the aperture and the points
    assert depth.min() > -1 and depth.max() < 1


def test_the_camera_does_not_widen_the_bounding_box(tmp_path):
    maps = dataclasses.replace(make_ball(), normal=None)
    write_asset(maps, tmp_path / "a.usdc", name="A")
    usd_stage = Usd.Stage.Open(str(tmp_path / "a.usdc"))
    box = UsdGeom.BBoxCache(Usd.TimeCode.Default(), ["default"]).ComputeWorldBound(usd_stage.GetDefaultPrim())
    extent = height_mesh(maps).extent
    np.testing.assert_allclose(box.ComputeAlignedRange().GetMin(), extent[0])
    np.testing.assert_allclose(box.ComputeAlignedRange().GetMax(), extent[1])


@pytest.mark.parametrize("space, said", [("lin_ap1_scene", True), ("lin_rec709_scene", False)])
def test_lights_that_rec709_does_not_hold_are_said(space, said, relit, tmp_path):
    maps = make_ball()
    maps.write(tmp_path / "maps.exr")
    capture_of(tmp_path / "rig", maps.camera, [{"type": "distant", "direction": [0, 0, 1], "irradiance": [0, 2, 0]}], color_space=space)
    green = np.zeros((32, 64), np.float16)
    exr.write(tmp_path / "sky.exr", {"R": green, "G": green + 1, "B": green}, color_space=space, metadata={})
    for given, name in (("--rig", tmp_path / "rig"), ("--environment", tmp_path / "sky.exr")):
        outcome = relit("export", tmp_path, "--out", tmp_path / "a.usda", given, name)
        assert outcome.code == 0 and ("has colours outside of Rec.709" in outcome.out) == said
