"""relit calibrate: what it writes into manifests and reports, and what it refuses without writing anything."""

import json
from functools import cache

import numpy as np
import pytest

from stage.capture.capture import Capture
from stage.capture.light import DistantLight, PointLight
from stage.stack.correction import Correction
from tests.marks import first_short
from tests.reference.balls import lambertian, lambertian_near, mirror_of_far, mirror_of_near, render
from tests.scenes.captures import (
    angles_degrees,
    edit_frame,
    edit_manifest,
    files_in,
    make_scene,
    write_capture,
    write_exr,
    write_image,
    write_lit,
)

WIDTH, HEIGHT = 96, 80
GEOMETRY = {"centre": np.array([0.0031, -0.0022, 0.0]), "radius": 0.03, "pixel_size": 0.001, "width": WIDTH, "height": HEIGHT}
CIRCLE = "51.1,42.2,30"
"""The same, as typed: u = 48 + 3.1, v = 40 + 2.2."""
DIRECTIONS = np.array([[0.0, 0.1, 1.0], [0.6, 0.0, 1.0], [-0.3, 0.5, 1.0], [-0.4, -0.4, 0.6], [0.2, -0.8, 0.5]])
DIRECTIONS /= np.linalg.norm(DIRECTIONS, axis=1, keepdims=True)
PLACEHOLDER = {"type": "distant", "direction": [0, 0, 1], "irradiance": [2, 2, 2]}


@cache
def mirror_images():
    return [render(mirror_of_far(direction, degrees=3), **GEOMETRY)[0] for direction in DIRECTIONS]


@cache
def grey_images():
    return [render(lambertian(d, albedo=0.5, irradiance=1 + i), **GEOMETRY)[0] for i, d in enumerate(DIRECTIONS)]


def write(folder, images, lights=None, **changes):
    """A capture of these images; its lights are placeholders unless given."""
    rows, cols = images[0].shape
    return write_lit(folder, images, lights or [PLACEHOLDER] * len(images), **{
        "name": "ball", "camera": {"projection": "orthographic", "resolution": [cols, rows], "pixel_size_m": 0.001}, **changes})


def mask_of(path, image):
    return write_image(path, (image * 255).astype(np.uint8))


def lights_of(folder, kind=DistantLight):
    return [light for _, light in Capture.open(folder).lit_by(kind)]


def report_of(folder, kind):
    return json.loads((folder / "calibration.json").read_text())[kind]


def test_mirror_ball_writes_directions_and_keeps_the_rest(relit, tmp_path):
    """A 30 px ball: 1 px is 3.8° of reflection, its spot is known to 0.05 px."""
    off = [{"image": "off.exr", "light": {"type": "off"}}]
    folder = write(tmp_path / "ball", mirror_images())
    write_exr(folder / "off.exr", np.zeros((HEIGHT, WIDTH, 3)))
    frames = json.loads((folder / "capture.json").read_text())["frames"]
    edit_manifest(folder, frames=off + frames, saturation=5.0, color_space="lin_ap1_scene")
    outcome = relit.done("calibrate", "mirror-ball", folder, "--ball", CIRCLE)
    lines = outcome.out.splitlines()
    assert lines[0] == f"capture  {folder}/capture.json" and lines[1] == f"report   {folder}/calibration.json"
    assert lines[2] == "lights   5 measured"
    assert lines[3].split() == ["frame", "direction", "sure", "to", "spot", "flags"] and len(lines) == 9
    capture = Capture.open(folder)
    found = np.array([light.direction for light in lights_of(folder)])
    assert angles_degrees(found, DIRECTIONS).max() < 0.2
    assert all(light.irradiance == (2, 2, 2) for light in lights_of(folder))
    assert capture.manifest.frames[0].light.type == "off"
    assert (capture.manifest.saturation, capture.manifest.color_space) == (5.0, "lin_ap1_scene")
    report = report_of(folder, "mirror-ball")
    assert [light["frame"] for light in report["lights"]] == [1, 2, 3, 4, 5]
    np.testing.assert_allclose([light["direction"] for light in report["lights"]], found, atol=1e-5)
    assert report["lights"][0]["was"] == PLACEHOLDER
    assert report["balls"][0]["radius_px"] == pytest.approx(30) and report["versions"]["numpy"]


def test_the_ball_is_calibrated_once_and_the_object_swapped_in(relit, tmp_path):
    ball, scene = write(tmp_path / "ball", mirror_images()), make_scene(16, 5)
    other = write_capture(tmp_path / "object", scene)
    edit_manifest(other, camera={"projection": "orthographic", "resolution": [WIDTH, HEIGHT]}, mask=None)
    for index in range(5):
        write_exr(other / f"{index:03d}.exr", np.ones((HEIGHT, WIDTH, 3)))
    before = (ball / "capture.json").read_bytes()
    mask = mask_of(tmp_path / "ball.png", render(lambertian(DIRECTIONS[0]), **GEOMETRY)[1])
    relit.done("calibrate", "mirror-ball", ball, "--ball-mask", mask, "--apply-to", other)
    assert (ball / "capture.json").read_bytes() == before and not (ball / "calibration.json").exists()
    lights = lights_of(other)
    assert angles_degrees(np.array([light.direction for light in lights]), DIRECTIONS).max() < 0.2
    np.testing.assert_allclose([light.irradiance for light in lights], scene.irradiance)  # what a mirror ball does not measure
    assert report_of(other, "mirror-ball")["applied_to"] == str(other)


def test_out_names_another_manifest(relit, tmp_path):
    folder = write(tmp_path / "ball", mirror_images())
    before = (folder / "capture.json").read_bytes()
    assert relit("calibrate", "mirror-ball", folder, "--ball", CIRCLE, "--out", tmp_path / "new" / "capture.json").code == 0
    assert (folder / "capture.json").read_bytes() == before
    assert files_in(tmp_path / "new") == {"capture.json", "calibration.json"}
    relit("calibrate", "mirror-ball", folder, "--ball", CIRCLE, "--out", folder / "000.exr").refused("000.exr: must be a .json file")


def test_frames_that_fail_are_named_or_left_out(relit, tmp_path):
    images = [*mirror_images()[:4], np.zeros((HEIGHT, WIDTH))]
    folder = write(tmp_path / "ball", images)
    before = {name: (folder / name).read_bytes() for name in files_in(folder)}
    relit("calibrate", "mirror-ball", folder, "--ball", CIRCLE).refused("004.exr: there is no bright spot on the ball; --drop-failed")
    assert {name: (folder / name).read_bytes() for name in files_in(folder)} == before
    assert "4 measured, 1 left out" in relit.done("calibrate", "mirror-ball", folder, "--ball", CIRCLE, "--drop-failed").out
    assert [frame.image for frame in Capture.open(folder).manifest.frames] == [f"{i:03d}.exr" for i in range(4)]
    assert report_of(folder, "mirror-ball")["lights"][4]["dropped"] == "there is no bright spot on the ball"


def test_two_balls_place_near_lights(relit, tmp_path):
    """Rays known to 0.1° meet at 0.4 m under an angle of 14° or more: 3 mm along them."""
    camera = {"radius": 0.035, "pixel_size": 0.001, "width": 240, "height": HEIGHT}
    positions = np.array([[0.1, 0.2, 0.35], [-0.2, -0.1, 0.4], [0.0, 0.3, 0.3]])
    centres = [np.array([-0.07, 0.001, 0.01]), np.array([0.08, -0.003, 0.01])]
    renders = [[render(mirror_of_near(p, degrees=3), centre=c, **camera) for c in centres] for p in positions]
    images = [np.maximum(left[0], right[0]) for left, right in renders]
    masks = [mask_of(tmp_path / f"mask{i}.png", renders[0][i][1]) for i in (0, 1)]
    folder = write(tmp_path / "balls", images)
    near = {"type": "point", "position_m": [0, 0, 1], "intensity": [3, 4, 5], "axis": [0, 0, -1], "anisotropy": 1}
    edit_frame(folder, 1, light=near)
    relit.done("calibrate", "light-positions", folder, "--ball-mask", masks[0], "--ball-mask", masks[1],
               "--ball-z-m", "0.01", "--ball-radius-m", "0.035")
    lights = lights_of(folder, PointLight)
    np.testing.assert_allclose([light.position_m for light in lights], positions, atol=0.005)
    assert lights[1].intensity == (3, 4, 5) and lights[1].anisotropy == 1  # what was known of a near light stays
    middle = np.mean(centres, axis=0)
    expected = 2 * ((np.array(lights[0].position_m) - middle) ** 2).sum()
    np.testing.assert_allclose(lights[0].intensity, expected, rtol=0.01)  # the same irradiance between the balls; radius by mask
    assert report_of(folder, "light-positions")["lights"][0]["residual_m"] < 0.002


def test_grey_ball_writes_irradiance(relit, tmp_path):
    lights = [{"type": "distant", "direction": d, "irradiance": [1, 1, 1]} for d in DIRECTIONS.tolist()]
    folder = write(tmp_path / "ball", grey_images(), lights)
    edit_manifest(folder, assumed=["the images are linear"])
    assert "warning  the images are linear" in relit.done("calibrate", "grey-ball", folder, "--ball", CIRCLE, "--albedo", "0.5").out
    assert report_of(folder, "grey-ball")["warnings"] == ["the images are linear"]
    found = np.array([light.irradiance for light in lights_of(folder)])
    np.testing.assert_allclose(found, np.arange(1, 6)[:, None] * np.ones(3), rtol=2e-3)  # a 30 px ball: curvature inside pixels
    assert Capture.open(folder).manifest.irradiance_scale == "absolute"
    assert relit("calibrate", "grey-ball", folder, "--ball", CIRCLE).code == 0
    found = np.array([light.irradiance for light in lights_of(folder)])
    np.testing.assert_allclose(found, np.arange(1, 6)[:, None] / 3 * np.ones(3), rtol=2e-3)
    assert Capture.open(folder).manifest.irradiance_scale == "relative"


@first_short("refined", [[], ["--refine-direction"]])
@first_short(("ambient", "said"), [(0.02, True), (0.0, False), (0.001, False)])
def test_light_of_the_room_is_told_by_the_dark_side_of_a_ball(relit, tmp_path, refined, ambient, said):
    """The brightest normals read 0.16 under the dimmest light: two hundredths are 12 % of that, and turn directions by degrees."""
    lights = [{**PLACEHOLDER, "direction": direction} for direction in DIRECTIONS.tolist()]
    folder = write(tmp_path / "ball", [image + np.float32(ambient) for image in grey_images()], lights)
    outcome = relit.done("calibrate", "grey-ball", folder, "--ball", CIRCLE, *refined)
    assert ("the dark side of the ball has" in outcome.out) == said, outcome.out
    assert (max(light["dark_side"] or 0 for light in report_of(folder, "grey-ball")["lights"]) > 0.05) == said
    write_exr(folder / "off.exr", np.full((HEIGHT, WIDTH, 3), ambient))
    edit_manifest(folder, frames=lambda frames: [*frames, {"image": "off.exr", "light": {"type": "off"}}])
    assert "the dark side" not in relit.done("calibrate", "grey-ball", folder, "--ball", CIRCLE, *refined).out


@pytest.mark.long
def test_a_ball_behind_an_analyser_shows_half_of_the_irradiance(relit, tmp_path):
    """Of a crossed and of a parallel one alike, because a matt ball keeps no polarisation; each frame keeps what it says of it."""
    lights = [{**PLACEHOLDER, "direction": direction.tolist(), "polarization": kind} for direction in DIRECTIONS
              for kind in ("cross", "parallel")]
    folder = write(tmp_path / "ball", [image / 2 for image in grey_images() for _ in range(2)], lights)
    assert relit("calibrate", "grey-ball", folder, "--ball", CIRCLE, "--albedo", "0.5").code == 0
    found = lights_of(folder)
    assert [light.polarization for light in found] == ["cross", "parallel"] * len(DIRECTIONS)
    assert np.allclose([light.irradiance for light in found], np.repeat(1 + np.arange(len(DIRECTIONS)), 2)[:, None], rtol=0.01)


def test_grey_ball_gives_directions_too(relit, tmp_path):
    folder = write(tmp_path / "ball", grey_images())
    relit.done("calibrate", "grey-ball", folder, "--ball", CIRCLE, "--refine-direction", "--albedo", "0.5,0.5,0.25")
    lights = lights_of(folder)
    assert angles_degrees(np.array([light.direction for light in lights]), DIRECTIONS).max() < 0.1
    np.testing.assert_allclose([light.irradiance for light in lights], np.arange(1, 6)[:, None] * [1, 1, 2], rtol=2e-3)


def test_grey_ball_measures_near_lights(relit, tmp_path):
    position = np.array([0.1, 0.05, 0.2])
    image = render(lambertian_near(position, albedo=0.5, intensity=0.7), **GEOMETRY)[0]
    light = {"type": "point", "position_m": position.tolist(), "intensity": [1, 1, 1]}
    folder = write(tmp_path / "ball", [image], [light])
    assert relit("calibrate", "grey-ball", folder, "--ball", CIRCLE, "--albedo", "0.5").code == 0
    np.testing.assert_allclose(lights_of(folder, PointLight)[0].intensity, 0.7, rtol=2e-3)
    relit("calibrate", "grey-ball", folder, "--ball", CIRCLE, "--refine-direction").refused("frames[0].light: is point")
    edit_manifest(folder, camera={"projection": "orthographic", "resolution": [WIDTH, HEIGHT]})
    relit("calibrate", "grey-ball", folder, "--ball", CIRCLE).refused("needs camera.pixel_size_m")


def test_intensity_from_the_object_itself(relit, tmp_path):
    scene = make_scene(32, 6)
    folder = write_capture(tmp_path / "cap", scene)
    for index, direction in enumerate(scene.directions.tolist()):
        edit_frame(folder, index, light={"type": "distant", "direction": direction, "irradiance": [1, 1, 1]})
    relit.done("calibrate", "intensity", folder)
    found = np.array([light.irradiance for light in lights_of(folder)])
    np.testing.assert_allclose(found, scene.irradiance / scene.irradiance.mean(axis=0), rtol=1e-5)  # float32 images
    assert report_of(folder, "intensity")["measured"] == 6
    assert Capture.open(folder).manifest.irradiance_scale == "relative"
    other = write_capture(tmp_path / "three", make_scene(8, 3))
    relit("calibrate", "intensity", other).refused("three/capture.json: frames: 3 distant lights: brightness")


@pytest.mark.long
def test_a_light_that_contradicts_the_others_has_no_strength_that_is_sure(relit, tmp_path):
    """The last frame shows the first light once more. A lamp of a quarter of the strength of the others is no contradiction; noise is half
    a percent of the brightest reading."""
    scene = make_scene(32, 12)
    folder = write_capture(tmp_path / "cap", scene)
    names = [frame.image for frame in Capture.open(folder).manifest.frames]
    random = np.random.default_rng(0)
    for name in names:
        read = Capture.open(folder).recorded(name) * (0.25 if name == names[5] else 1)
        write_exr(folder / name, np.abs(read + random.normal(0, 0.005 * read.max(), read.shape)))
    relit.done("calibrate", "intensity", folder)
    assert not any("contradict" in words for light in report_of(folder, "intensity")["lights"] for words in light["flags"])
    write_exr(folder / names[-1], Capture.open(folder).recorded(names[0]))
    assert f"frames: {names[-1]}: readings contradict those under the other lights" in relit.done("calibrate", "intensity", folder).out
    light = report_of(folder, "intensity")["lights"][-1]
    assert light["uncertainty"] == [1, 1, 1] and "check its direction and image" in light["flags"][-1]


def test_dark_and_flat_are_named_by_the_manifest_and_used(relit, tmp_path):
    scene = make_scene(16, 4)
    folder = write_capture(tmp_path / "cap", scene)
    dark, flat = 0.01, np.linspace(0.5, 1, 16)[None, :, None] * np.ones((16, 16, 3))
    for index, image in enumerate(scene.images):
        write_exr(folder / f"{index:03d}.exr", image * flat + dark)
    darks = [write_exr(tmp_path / f"d{i}.exr", np.full((16, 16, 3), dark + 0.001 * (i - 1))) for i in range(3)]
    whites = [write_exr(tmp_path / f"w{i}.exr", flat * (0.8 + 0.1 * i) + dark) for i in range(2)]
    outcome = relit("calibrate", "dark", folder, *darks)
    assert outcome == (0, f"dark     {folder}/dark.exr\ncapture  {folder}/capture.json\nreport   {folder}/calibration.json\n", "")
    assert relit("calibrate", "flat-field", folder, *whites).code == 0
    assert set(json.loads((folder / "calibration.json").read_text())) == {"schema", "dark", "flat-field"}
    assert relit("info", folder).code == 0
    capture = Capture.open(folder)
    correction = Correction.of(capture)
    for frame, image in zip(capture.manifest.frames, scene.images, strict=True):
        lit = scene.mask & (image > 0.01).all(axis=-1)
        ratio = correction.apply(frame).pixels[lit] / image[lit]
        np.testing.assert_allclose(ratio / flat[scene.mask].mean(axis=0), 1, rtol=1e-4)  # float32, less a dark of a tenth of it
    relit("calibrate", "dark", folder, folder / "dark.exr").refused("dark.exr: is the file that is written")
    assert relit("calibrate", "flat-field", folder, *whites, "--dark", darks[0], "--dark", darks[2]).code == 0


def test_saturation_is_said_and_written(relit, tmp_path):
    scene = make_scene(32, 4)
    scene = scene._replace(images=np.minimum(scene.images, 0.15))
    folder = write_capture(tmp_path / "cap", scene)
    before = (folder / "capture.json").read_bytes()
    outcome = relit("calibrate", "saturation", folder)
    assert outcome.code == 0 and outcome.out.startswith("level    0.1485\nreadings ")
    assert (folder / "capture.json").read_bytes() == before
    assert relit("calibrate", "saturation", folder, "--write").code == 0
    assert Capture.open(folder).manifest.saturation == pytest.approx(0.1485)
    relit("calibrate", "saturation", write_capture(tmp_path / "dim", make_scene(8, 4))).refused("dim: no channel piles up")


BALL = ["--ball", CIRCLE]
BAD = {
    "one ball in sight": (["light-positions"], {}, "mirror ball is found in the images"),
    "radii without balls": (["light-positions", "--ball-radius-m", "0.1", "--ball-radius-m", "0.2"], {},
                            "--ball-radius-m: is given 2 times, and no ball is named that"),
    "two balls": (["mirror-ball", *BALL, *BALL], {}, "2 balls are given: this needs exactly 1"),
    "one ball for positions": (["light-positions", *BALL], {}, "1 balls are given: this needs 2 or more"),
    "a ball in words": (["mirror-ball", "--ball", "middle"], {}, "--ball middle: give centre and radius in pixels"),
    "two numbers": (["mirror-ball", "--ball", "4,5"], {}, "--ball 4,5: give centre and radius"),
    "a ball of no size": (["mirror-ball", "--ball", "48,40,0"], {}, "radius_px: is 0.0: input should be greater than 0"),
    "off the image": (["mirror-ball", "--ball", "48,40,60"], {}, "ball 48,40,60: is not wholly inside the 96x80 image"),
    "no mask file": (["mirror-ball", "--ball-mask", "none.png"], {}, "none.png: no such file"),
    "empty mask": (["mirror-ball", "--ball-mask", "empty.png"], {}, "empty.png: the mask of the ball has an outline of 0 points"),
    "mask of another size": (["mirror-ball", "--ball-mask", "small.png"], {}, "small.png: is 4x4, camera.resolution says 96x80"),
    "level": (["mirror-ball", *BALL, "--level", "1"], {}, "level: is 1.0: input should be less than 1"),
    "albedo": (["grey-ball", *BALL, "--albedo", "0.5,0.5"], {}, "--albedo 0.5,0.5: give one number or three"),
    "albedo in percent": (["grey-ball", *BALL, "--albedo", "18"], {},
                          "--albedo 18: nothing reflects more than all light: give a part of it, such as 0.18 for 18 %"),
    "radii": (["light-positions", *BALL, *BALL, *BALL, "--ball-radius-m", "0.1", "--ball-radius-m", "0.1"], {},
              "--ball-radius-m: is given 2 times for 3 balls"),
    "radius in millimetres": (["light-positions", *BALL, "--ball", "20,20,10", "--ball-radius-m", "30"], {},
                              "--ball-radius-m: is 30, and no calibration ball has a radius of 30 m: give it in metres"),
    "radius against scale": (["light-positions", *BALL, *BALL, "--ball-radius-m", "0.1"], {},
                             "it ball 1 has a radius of 0.03 m, --ball-radius-m says 0.1"),
    "no scale": (["light-positions", *BALL, *BALL, "--ball-radius-m", "0.03"],
                 {"camera": {"projection": "orthographic", "resolution": [WIDTH, HEIGHT]}},
                 "missing: near lights need a scale: by the ball it is 0.001"),
    "no radius": (["light-positions", *BALL, *BALL],
                  {"camera": {"projection": "perspective", "resolution": [WIDTH, HEIGHT], "focal_px": [200, 200]}},
                  "--ball-radius-m: is missing: a perspective camera"),
    "one ball twice": (["light-positions", *BALL, *BALL], {}, "000.exr: the rays from the balls are 0.00° from parallel"),
    "no lights": (["mirror-ball", *BALL], {"frames": [{"image": "000.exr", "light": {"type": "off"}}]},
                  "frames: none is lit by a distant or point light"),
    "another count": (["mirror-ball", *BALL, "--apply-to", "three"], {}, "three/capture.json: frames: 3 are lit by"),
    "another camera": (["mirror-ball", *BALL, "--apply-to", "five"], {}, "five/capture.json: camera.resolution: differs"),
    "out": (["mirror-ball", *BALL, "--out", "result"], {}, "--out result: must be a .json file"),
    "few pixels": (["intensity", "--pixels", "1"], {}, "pixels: is 1: input should be greater than or equal to 100"),
    "no images": (["dark"], {}, "missing argument"),
    "dark of another size": (["dark", "small.png"], {}, "small.png: is 4x4"),
    "dark card": (["flat-field", "empty.png"], {}, "the white card is not brighter than the dark frame"),
}


@pytest.mark.parametrize("fault", BAD)
def test_bad_calibrations(relit, tmp_path, monkeypatch, fault):
    monkeypatch.chdir(tmp_path)
    (kind, *arguments), changes, words = BAD[fault]
    write(tmp_path / "ball", mirror_images(), **changes)
    write_capture(tmp_path / "three", make_scene(8, 3))
    write_capture(tmp_path / "five", make_scene(8, 5))
    write_image(tmp_path / "empty.png", np.zeros((HEIGHT, WIDTH), np.uint8))
    write_image(tmp_path / "small.png", np.zeros((4, 4), np.uint8))
    before = {name: (tmp_path / name).read_bytes() for name in files_in(tmp_path)}
    relit("calibrate", kind, "ball", *arguments).refused(words)
    assert {name: (tmp_path / name).read_bytes() for name in files_in(tmp_path)} == before


def test_drowned_in_light(relit, tmp_path):
    """Every ball saturated all over: every frame fails, and --drop-failed is no way round it."""
    folder = write(tmp_path / "ball", [np.full((HEIGHT, WIDTH), 1.0)] * 3, saturation=0.98)
    relit("calibrate", "mirror-ball", folder, "--ball", CIRCLE, "--drop-failed").refused(
        "000.exr: there is no bright spot on the ball (and 2 more")
    image = np.where(render(mirror_of_far(DIRECTIONS[0], degrees=40), **GEOMETRY)[0] > 0.3, 1.0, 0.0)
    folder = write(tmp_path / "wide", [image] * 3, saturation=0.98)
    relit("calibrate", "mirror-ball", folder, "--ball", CIRCLE).refused("% of the ball: shorten the exposure")
