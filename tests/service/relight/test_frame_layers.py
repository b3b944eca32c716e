"""Frames as a compositor gets them: layers by name, parts, lossless data, the matte, and the attributes of camera and time."""

import json
import re
from fractions import Fraction

import numpy as np
import OpenEXR
import OpenImageIO as oiio
import pytest

from service.relight.attributes import camera_attributes
from stage.capture.camera import Camera
from stage.colour.colour import rgb_matrix
from stage.formats import exr
from stage.results.maps import SurfaceMaps
from tests.marks import first_short
from tests.scenes.captures import edit_manifest, files_in, make_scene, write_capture, write_exr
from tests.scenes.coverage import render_covered, write_covered

SCENE = make_scene(size=20, lights=9)
POSE = [[0, 0, 1, 0.5], [0, 1, 0, 0.25], [-1, 0, 0, 2], [0, 0, 0, 1]]
CAMERA = {"projection": "orthographic", "resolution": [20, 20], "pixel_size_m": 0.01, "surface_z_m": -1.5, "world_from_camera": POSE}
DATA = ("mask", "normal", "world_normal", "position", "depth", "confidence")
KEYS = {"schema": "relit.keys/1", "frames_per_second": 23.976, "lights": [
    {"name": "key", "keys": [{"frame": 1, "direction": [-0.4, 0.3, 0.8], "irradiance": [3, 2, 1], "angle_degrees": 9}]},
    {"name": "キー", "keys": [{"frame": 1, "direction": [0.3, 0.1, 0.8], "irradiance": [1, 1, 2], "angle_degrees": 9}]},
    {"name": "key", "keys": [{"frame": 1, "direction": [0, -0.4, 0.8], "irradiance": [0.5, 1, 1]}]}],
    "captured": [{"image": "002.exr", "keys": [{"frame": 1, "weight": 0.4}]}]}


def write_maps(folder, **changes):
    """Write the true normals and albedo of the capture, and a height that is not quite theirs."""
    folder.mkdir(exist_ok=True)
    confidence = np.random.default_rng(4).random(SCENE.mask.shape).astype(np.float16)
    layers = {"normal": SCENE.normal.astype(np.float32), "diffuse_albedo": SCENE.albedo, "confidence": confidence,
              "height": (-1.5 + 0.14 * SCENE.normal[..., 2]).astype(np.float32), **changes}
    SurfaceMaps(camera=Camera.model_validate(CAMERA), mask=SCENE.mask, **layers).write(folder / "maps.exr")


@pytest.fixture
def lit(relit, tmp_path):
    """Relight a capture and its maps with further options; the folder of the frames."""
    write_capture(tmp_path / "cap", SCENE, camera=CAMERA)
    sky = write_exr(tmp_path / "sky.exr", np.random.default_rng(1).random((8, 16, 3)))
    (tmp_path / "keys.json").write_text(json.dumps(KEYS))
    write_maps(tmp_path / "maps")

    def run(name, *options, maps=True):
        given = ("--maps", tmp_path / "maps") if maps else ()
        relit.done("relight", tmp_path / "cap", "--environment", sky, "--out", tmp_path / name / "a.####.exr", *given, *options)
        return tmp_path / name

    return run


def stacked(channels, layer, suffixes):
    return np.stack([channels[f"{layer}.{suffix}"] for suffix in suffixes], axis=-1)


def test_a_shot_of_acescg_with_a_lossy_beauty_has_bit_exact_data(lit, tmp_path):
    out = lit("f", "--frames", "1001-1002", "--color-space", "lin_ap1_scene", "--compression", "dwaa", "--aov",
              f"diffuse,specular,albedo,{','.join(DATA)}")
    assert files_in(out) == {"a.1001.exr", "a.1002.exr"}
    maps = SurfaceMaps.read(tmp_path / "maps" / "maps.exr")
    for number in (1001, 1002):
        channels, metadata = exr.read(out / f"a.{number}.exr")
        assert exr.color_space_of(metadata) == "lin_ap1_scene" and metadata["relit:frame"] == str(number)
        pose = np.array(POSE)
        points = maps.camera.points(maps.height) @ pose[:3, :3].T + pose[:3, 3]
        inside = maps.mask[..., None]
        expected = {
            "mask.Y": maps.mask, "confidence.Y": maps.confidence, "normal.XYZ": maps.normal, "N.XYZ": maps.normal @ pose[:3, :3].T,
            "P.XYZ": np.where(inside, points, 0), "depth.Z": np.where(maps.mask, -maps.height, 0),
            "albedo.RGB": maps.diffuse_albedo @ rgb_matrix(maps.color_space, "lin_ap1_scene").T,
        }
        for names, values in expected.items():
            layer, suffixes = names.split(".")
            dtype = np.float32 if layer in ("P", "depth") else np.float16
            found = stacked(channels, layer, suffixes)
            assert found.dtype == dtype and np.array_equal(found, values.reshape(*found.shape).astype(dtype)), names
        assert 1.35 < channels["depth.Z"][maps.mask].min() < channels["depth.Z"].max() < 1.5  # in front of the camera
    with OpenEXR.File(str(out / "a.1001.exr")) as file:
        assert {part.name() for part in file.parts} == {"rgba", "specular", "diffuse", "mask", "normal", "N", "P", "depth", "albedo",
                                                        "confidence"} and file.parts[0].name() == "rgba"
        for part in file.parts:
            colour = part.name() in ("rgba", "diffuse", "specular", "albedo")
            assert part.header["colorInteropID"] == ("lin_ap1_scene" if colour else "data")
            assert ("chromaticities" in part.header) == colour
            lossy = part.name() in ("rgba", "diffuse", "specular")
            assert part.header["compression"] == (OpenEXR.DWAA_COMPRESSION if lossy else OpenEXR.ZIP_COMPRESSION)
            for window in ("dataWindow", "displayWindow"):
                assert [corner.tolist() for corner in part.header[window]] == [[0, 0], [19, 19]]


def test_other_programs_find_the_layers(lit):
    path = lit("f", "--aov", "normal,depth", "--parts", "multi") / "a.0001.exr"
    source = oiio.ImageInput.open(str(path))
    parts = {}
    while source.seek_subimage(len(parts), 0):
        spec = source.spec()
        parts[spec.getattribute("oiio:subimagename")] = (spec.channelnames, spec.getattribute("oiio:ColorSpace"), spec.alpha_channel)
    source.close()
    assert parts == {"rgba": (("R", "G", "B", "A"), "lin_rec709_scene", 3), "normal": (("normal.X", "normal.Y", "normal.Z"), "data", -1),
                     "depth": (("depth.Z",), "data", -1)}


@first_short(("options", "several"), [
    (("--aov", "normal"), False), (("--aov", "normal", "--parts", "multi"), True), (("--compression", "dwaa"), False),
    (("--compression", "dwaa", "--aov", "diffuse"), False), (("--compression", "dwaa", "--aov", "mask"), True),
    (("--compression", "piz", "--aov", "mask"), False)])
def test_layers_have_parts_where_the_beauty_is_lossy(lit, options, several):
    with OpenEXR.File(str(lit("f", *options) / "a.0001.exr")) as file:
        assert (len(file.parts) > 1) == several


@first_short("guided", [False, True])
def test_layers_of_lights_add_up_to_the_beauty(lit, tmp_path, guided):
    options = ("--keys", tmp_path / "keys.json", "--frames", "1-2")
    out = lit("f", *options, "--aov", "lights", maps=guided)
    names = ["light_environment", "light_key", "light_3", "light_key_4", "light_002"]
    for number in (1, 2):
        channels, _ = exr.read(out / f"a.000{number}.exr")
        assert set(channels) == {*"RGBA", *(f"{name}.{c}" for name in names for c in "RGB")}
        whole = np.stack([channels[c] for c in "RGB"], axis=-1).astype(np.float64)
        layers = [stacked(channels, name, "RGB").astype(np.float64) for name in names]
        assert all(layer.max() > 0.01 for layer in layers)
        assert np.allclose(sum(layers), whole, rtol=2e-3, atol=1e-4)  # half rounding of six pictures
    captured = np.where(SCENE.mask[..., None], SCENE.images[2], 0) * 0.4
    assert np.allclose(layers[-1], captured, rtol=0.05 if guided else 2e-3, atol=1e-3)
    assert np.array_equal(exr.read(lit("g", *options, maps=guided) / "a.0001.exr")[0]["R"], exr.read(out / "a.0001.exr")[0]["R"])


def nuke_channel(name: str) -> tuple[str, str]:
    """Layer and channel of a channel of a file by the rule of Nuke's reader (Foundry, NDK, ExrChannelNameToNuke): words between dots lose
    digits at their beginning, other signs than letters and digits become _, and all but the last word are the layer."""
    *layer, channel = [re.sub(r"[^A-Za-z0-9]", "_", word.lstrip("0123456789")) for word in name.split(".")]
    return "_".join(layer) or "rgba", {"R": "red", "G": "green", "B": "blue", "A": "alpha"}.get(channel, channel)


@pytest.mark.parametrize("parts", ["single", "multi"])
def test_nuke_finds_a_layer_for_each_light(lit, tmp_path, parts):
    out = lit("f", "--keys", tmp_path / "keys.json", "--frames", "1", "--aov", "lights", "--parts", parts, maps=False)
    with OpenEXR.File(str(out / "a.0001.exr"), separate_channels=True) as file:
        names = [name for part in file.parts for name in part.channels]
    layers = ["light_environment", "light_key", "light_3", "light_key_4", "light_002"]
    assert sorted(map(nuke_channel, names)) == sorted(
        [(layer, channel) for layer in ["rgba", *layers] for channel in ("red", "green", "blue")] + [("rgba", "alpha")])


def test_an_environment_alone_is_one_layer(lit):
    channels, _ = exr.read(lit("f", "--aov", "lights", maps=False) / "a.0001.exr")
    assert set(channels) == {*"RGBA", *(f"light_environment.{c}" for c in "RGB")}
    assert all(np.array_equal(channels[f"light_environment.{c}"], channels[c]) for c in "RGB")


@pytest.mark.long
def test_the_beauty_is_premultiplied_by_its_matte(relit, tmp_path):
    scene = render_covered(lights=16)
    folder = write_covered(tmp_path / "cap", scene, scene.coverage > 0.5)
    sky = write_exr(tmp_path / "sky.exr", np.ones((16, 32, 3)))

    def frame(name, *options):
        outcome = relit.done("relight", folder, "--environment", sky, "--out", tmp_path / name / "a.#.exr", *options)
        return exr.read(tmp_path / name / "a.1.exr")[0], outcome.out

    soft, out = frame("soft", "--exposure", "1", "--report", tmp_path / "r.json")
    hard, _ = frame("hard", "--matte", "mask")
    plain, _ = frame("plain", "--matte", "none", "--parts", "multi")
    assert "matte    soft, estimated from the captured images" in out
    assert json.loads((tmp_path / "r.json").read_text())["matte"] == {"images": 1}
    assert "A" not in plain and np.array_equal(hard["A"], scene.coverage > 0.5)
    partly = (scene.coverage > 0) & (scene.coverage < 1)
    assert np.abs(soft["A"].astype(float) - scene.coverage)[partly].mean() < 0.05
    held = soft["A"] > 0
    # the images are premultiplied, so a soft matte changes them nowhere, and removes the noise around them
    assert np.allclose(soft["G"].astype(float), np.where(held, 2.0 * plain["G"], 0), rtol=1e-3) and not soft["G"][~held].any()
    assert plain["G"][~held].any() and not hard["G"][hard["A"] == 0].any()


@pytest.mark.parametrize("guided", [False, True])
def test_pictures_of_maps_have_the_matte_of_maps_or_capture(relit, lit, tmp_path, guided):
    given = ("--capture", tmp_path / "cap") if guided else ()
    relit.done("shade", tmp_path / "maps", "--light", "0,0,1,3,3,3", "--out", tmp_path / "p.exr", "--aov", "depth,position,mask",
               "--compression", "dwaa", *given)
    channels, metadata = exr.read(tmp_path / "p.exr")
    assert set(channels) == {*"RGBA", "depth.Z", "P.X", "P.Y", "P.Z", "mask.Y"}
    assert np.array_equal(channels["A"], SCENE.mask) and np.abs(channels["G"][~SCENE.mask]).max() < 1e-4  # DWAA
    assert "worldToCamera" in metadata and "framesPerSecond" not in metadata  # a single picture


@pytest.mark.parametrize(("options", "words"), [
    (("--aov", "depth"), "--aov depth needs --maps DIR"), (("--aov", "position"), "--aov position needs --maps DIR"),
    (("--aov", "albedo"), "--aov albedo needs --maps DIR"), (("--aov", "world_normal"), "--aov world_normal needs --maps DIR"),
    (("--aov", "mask", "--compression", "dwaa", "--parts", "single"), "--compression dwaa would change the layer mask"),
    (("--frames-per-second", "0"), "greater than or equal to 0.001"), (("--frames-per-second", "-24"), "greater than or equal to 0.001"),
    (("--frames-per-second", "nan"), "finite"), (("--frames-per-second", "1e9"), "1000"),
    (("--frames-per-second", "0.0004"), "greater than or equal to 0.001"),
    (("--frames-per-second", "25", "--keys", "keys.json"), "keys.json has frames_per_second 23.976: give one of them"),
    (("--aov", "lights", "--keys", "many.json"), "33 lights: there are at most 32"),
    (("--matte", "fuzzy"), "fuzzy"), (("--parts", "3"), "3"),
])
def test_bad_options_of_layers(relit, tmp_path, monkeypatch, options, words):
    monkeypatch.chdir(tmp_path)
    write_capture(tmp_path / "cap", SCENE)
    (tmp_path / "keys.json").write_text(json.dumps(KEYS))
    (tmp_path / "many.json").write_text(json.dumps({"schema": "relit.keys/1", "lights": KEYS["lights"][:1] * 32}))
    write_exr(tmp_path / "sky.exr", np.ones((8, 16, 3)))
    relit("relight", "cap", "--environment", "sky.exr", "--out", "f/a.#.exr", *options).refused(words)
    assert not (tmp_path / "f").exists()


def test_maps_without_height_have_no_depth(relit, lit, tmp_path):
    write_maps(tmp_path / "maps", height=None)
    outcome = relit("relight", tmp_path / "cap", "--environment", tmp_path / "sky.exr", "--out", tmp_path / "f" / "a.#.exr",
                    "--maps", tmp_path / "maps", "--aov", "depth")
    assert outcome.code == 2 and outcome.err == f"relit: {tmp_path / 'maps' / 'maps.exr'}: has no layer height, which --aov depth needs\n"


@first_short(("rate", "number", "fraction", "code"), [
    (None, 1001, Fraction(24), (0, 0, 41, 17)), ("25", 90000, Fraction(25), (1, 0, 0, 0)), ("59.94", 7, Fraction(60000, 1001), None),
    ("29.97", 31, Fraction(30000, 1001), (0, 0, 1, 1)), ("12.5", 106, Fraction(25, 2), None),
    ("keys", 24, Fraction(24000, 1001), (0, 0, 1, 0))])
def test_the_rate_and_the_time_code_of_a_frame(lit, tmp_path, rate, number, fraction, code):
    options = () if rate is None else ("--keys", tmp_path / "keys.json") if rate == "keys" else ("--frames-per-second", rate)
    path = lit("f", "--frames", str(number), *options, maps=False) / f"a.{number:04d}.exr"
    metadata = exr.read_header(path).metadata
    assert metadata["framesPerSecond"] == fraction
    given = metadata.get("timeCode")
    assert (None if given is None else (given.hours, given.minutes, given.seconds, given.frame)) == code


def test_another_rate_makes_frames_anew(lit, tmp_path):
    path = lit("f", maps=False) / "a.0001.exr"
    lit("f", "--frames-per-second", "25", maps=False)
    assert exr.read_header(path).metadata["framesPerSecond"] == 25


@pytest.mark.parametrize("camera", [
    Camera(projection="perspective", resolution=(64, 48), focal_px=(80.0, 80.2), principal_px=(30.0, 25.0), world_from_camera=POSE),
    Camera(projection="orthographic", resolution=(64, 48), pixel_size_m=0.01, principal_px=(30.0, 25.0), world_from_camera=POSE)])
def test_the_matrices_of_the_camera_project_the_points_of_pixels(camera):
    """Row vectors times the matrices, as the OpenEXR documentation defines them: a left-handed camera frame, NDC from the upper left."""
    height = np.full((48, 64), -1.25, np.float32)
    pose = np.array(POSE, dtype=np.float64)
    world = camera.points(height).astype(np.float64) @ pose[:3, :3].T + pose[:3, 3]
    rows = np.concatenate([world, np.ones((48, 64, 1))], axis=-1)
    attributes = camera_attributes(camera)
    seen = rows @ attributes["worldToCamera"].astype(np.float64)
    assert np.allclose(seen[..., 2], 1.25, atol=1e-5) and np.allclose(seen[..., :2], camera.points(height)[..., :2], atol=1e-5)
    ndc = rows @ attributes["worldToNDC"].astype(np.float64)
    ndc /= ndc[..., 3:]
    assert np.allclose(ndc[..., 0], (np.arange(64) + 0.5) / 64, atol=1e-5)
    assert np.allclose(ndc[..., 1], ((np.arange(48) + 0.5) / 48)[:, None], atol=1e-5)
    if camera.projection == "perspective":
        # the screen window: where the borders of the image are on the plane at distance 1
        left = attributes["screenWindowCenter"][0] - attributes["screenWindowWidth"] / 2
        assert left == pytest.approx((0 - 30) / 80) and "pixelAspectRatio" not in attributes
        top = attributes["screenWindowCenter"][1] + attributes["screenWindowWidth"] / 2 * 48 / 64
        assert top == pytest.approx(25 / 80.2, rel=0.01)  # as far as the pixels are square


def test_a_pose_that_changes_makes_frames_anew(relit, tmp_path):
    write_capture(tmp_path / "cap", SCENE, camera=CAMERA)
    sky = write_exr(tmp_path / "sky.exr", np.ones((8, 16, 3)))
    arguments = "relight", tmp_path / "cap", "--environment", sky, "--out", tmp_path / "a.#.exr"
    places = []
    for pose in (POSE, [[0, 0, 1, 7.5], *POSE[1:]]):
        edit_manifest(tmp_path / "cap", camera={**CAMERA, "world_from_camera": pose})
        assert relit(*arguments).code == 0
        places.append(np.linalg.inv(exr.read_header(tmp_path / "a.1.exr").metadata["worldToCamera"].astype(float))[3, :3])
    assert np.allclose(places, [[0.5, 0.25, 2], [7.5, 0.25, 2]], atol=1e-5)
