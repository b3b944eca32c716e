"""relit calibrate chart, on charts of a renderer of these tests, which knows where they are and what the camera makes of their colours."""

import json

import cv2
import numpy as np
import OpenImageIO as oiio
import pytest

from service.calibrate.chart import calibrate_chart
from service.calibrate.solvers.cielab import delta_e_2000
from service.requests.chart import ChartKind, ChartRequest
from stage.capture.capture import Capture
from stage.colour.colour import rgb_matrix
from stage.stack.correction import Correction
from tests.reference.colour import srgb
from tests.scenes.captures import edit_manifest, write_image
from tests.scenes.chart import (
    CAMERA,
    D65_FROM_D50,
    PASSPORT_PATCH,
    REC709_FROM_XYZ,
    WHITE_D50,
    Picture,
    Pose,
    other_page,
    picture,
    poses,
    reflectances,
    shoot,
    table,
)

REFLECTANCE = reflectances()
NOISE, EXPOSURE = 0.01, 0.5
LIGHTS = ((1.0, 1.0, 1.0), (1.3, 1.0, 0.45), (0.75, 1.0, 1.35))
"""Daylight, tungsten and an overcast sky, as the camera sees white under them."""
POSE = Pose(15, -11, 3, 10, -8, 700)


def seen(light=LIGHTS[0], reflectance=REFLECTANCE):
    """What the camera sees of patches."""
    return EXPOSURE * np.array(light) * (reflectance @ CAMERA.T)


def noisy(pixels, seed=0, noise=NOISE):
    return np.maximum(pixels + np.random.default_rng(seed).normal(size=pixels.shape) * noise, 0)


def difference(matrix, light=LIGHTS[0]):
    """CIEDE2000 of each patch that the camera sees without noise through a matrix, at the exposure at which greys are right."""
    def lab(linear):
        root = np.cbrt(linear @ np.linalg.inv(D65_FROM_D50.T @ REC709_FROM_XYZ.T) / WHITE_D50)
        return np.stack([116 * root[:, 1] - 16, 500 * (root[:, 0] - root[:, 1]), 200 * (root[:, 1] - root[:, 2])], axis=1)
    through = seen(light) @ np.array(matrix).T
    return delta_e_2000(lab(through * REFLECTANCE[18:, 1].sum() / through[18:, 1].sum()), lab(REFLECTANCE))


def section(folder, name="calibration.json"):
    return json.loads((folder / name).read_text())["chart"]


@pytest.mark.long
def test_charts_are_found_and_colours_corrected_in_twenty_poses_and_three_lights(tmp_path):
    for number, pose in enumerate(poses(20)):
        light = LIGHTS[number % 3]
        shown = picture(seen(light), pose, seed=number)
        folder = shoot(tmp_path / str(number), [noisy(shown.pixels, number)])
        found = calibrate_chart(ChartRequest(capture=folder))
        assert np.linalg.norm(found.corners - shown.corners, axis=1).max() < 0.5, number  # of the 2 px that are asked for
        assert np.nanmean(found.kinds[0].colors.after) < 1.0, number
        assert not found.kinds[0].colors.refused
        # without the noise of the patches themselves: what the matrix does to colours
        matrix = Capture.open(folder).manifest.color_matrix
        assert difference(matrix, light).mean() < 0.6, number
        assert difference(np.eye(3), light).mean() > 5


@pytest.mark.long
def test_a_chart_corrects_the_capture_and_the_report_says_by_how_much(relit, tmp_path):
    shown = picture(seen(), POSE)
    folder = shoot(tmp_path / "cap", [noisy(shown.pixels)])
    printed = relit.done("calibrate", "chart", folder).out
    assert "24 of 24 patches" in printed and "warning" not in printed
    chart = section(folder)
    kind, = chart["kinds"]
    assert kind["delta_e_2000"]["before"]["mean"] > 5 > 1 > kind["delta_e_2000"]["after"]["mean"]
    assert [patch["name"] for patch in kind["patches"]] == [row["name"] for row in table()]
    assert all(patch["after"] < 4 for patch in kind["patches"])
    assert kind["response"] == pytest.approx(1, abs=0.03) and kind["light_falls_to"] > 0.95
    np.testing.assert_allclose(chart["corners"], shown.corners, atol=0.5)
    assert cv2.imread(str(folder / "chart.png")).shape[0] > 300
    texts = oiio.ImageBuf(str(folder / "chart.png")).spec()  # as all sheets have them
    assert texts.getattribute("relit:ocio").startswith("ocio://default") and texts.getattribute("relit:ocio_cache_id")
    capture = Capture.open(folder)
    white = Correction.of(capture).apply(capture.manifest.frames[0]).pixels
    u, v = shown.corners[3].astype(int)
    patch = white[v - 5 : v + 6, u - 5 : u + 6].mean(axis=(0, 1))
    grey = seen()[18:].mean(axis=0)[1] / REFLECTANCE[18:, 1].mean()  # greys keep their green
    np.testing.assert_allclose(patch, grey * REFLECTANCE[18], rtol=0.02)  # the noise of 121 pixels
    # the matrix leads into the working space: greys are (1, 1, 1) in ACEScg too, and colours those that OpenColorIO makes of them
    edit_manifest(folder, color_space="lin_ap1_scene", color_matrix=None)
    relit.done("calibrate", "chart", folder, "--out", tmp_path / "aces.json")
    aces = np.array(json.loads((tmp_path / "aces.json").read_text())["color_matrix"])
    into = rgb_matrix("lin_rec709_scene", "lin_ap1_scene") @ np.array(kind["matrix"])
    np.testing.assert_allclose(aces / aces.sum(), into / into.sum(), atol=2e-4)  # float32 of OpenColorIO, and where the search ends
    edit_manifest(folder, color_space="lin_rec709_scene", color_matrix=kind["matrix"])
    # once more, from the corrected capture: what is there is replaced
    relit.done("calibrate", "chart", folder, "--out", tmp_path / "again.json")
    again = section(tmp_path)["kinds"][0]
    assert again["matrix"] == kind["matrix"]
    assert again["delta_e_2000"]["before"]["mean"] == pytest.approx(kind["delta_e_2000"]["after"]["mean"], abs=0.05)


@pytest.mark.long
def test_integers_in_another_space_and_a_chart_that_stands_on_its_head(relit, tmp_path):
    shown = picture(seen(), POSE)
    folder = shoot(tmp_path / "cap", [noisy(shown.pixels)])
    encoded = srgb(noisy(shown.pixels)[::-1, ::-1])
    write_image(folder / "0.png", np.rint(encoded * 65535).astype(np.uint16))
    edit_manifest(folder, color_space="srgb_texture", frames=[{"image": "0.png", "light": {"type": "full"}}])
    printed = relit.done("calibrate", "chart", folder).out
    assert "the chart is upside down" in printed
    rows, cols = shown.pixels.shape[:2]
    np.testing.assert_allclose(section(folder)["corners"], [cols, rows] - shown.corners, atol=0.5)
    # given in another order, the corners are put right by the colours
    corners = ([cols, rows] - shown.corners)[[2, 3, 0, 1]].round(1)
    relit.done("calibrate", "chart", folder, "--corners", ",".join(map(str, corners.ravel())))
    np.testing.assert_allclose(section(folder)["corners"], [cols, rows] - shown.corners, atol=0.5)
    assert difference(Capture.open(folder).manifest.color_matrix).mean() < 0.6


def stain(shown: Picture, patches: dict[int, float], columns=6) -> np.ndarray:
    """Add light to patches of a picture, by their numbers from 1 on."""
    pixels = shown.pixels.copy()
    a, b, _, d = shown.corners
    for number, more in patches.items():
        x, y = (number - 1) % columns / (columns - 1), (number - 1) // columns / 3
        u, v = np.rint(a + x * (b - a) + y * (d - a)).astype(int)
        pixels[v - 22 : v + 22, u - 22 : u + 22] += more
    return pixels


@pytest.mark.long
def test_patches_that_are_clipped_shadowed_or_glaring_are_left_out_by_name(relit, tmp_path):
    shown = picture(seen(), Pose(distance=700))
    pixels = stain(shown, {14: 0.1, 24: 0.05, 8: -0.035})
    pixels[:, :] = np.minimum(noisy(pixels, noise=0.002), 0.4)
    folder = shoot(tmp_path / "cap", [pixels], saturation=0.399)
    printed = relit("calibrate", "chart", folder).out
    for sentence in ("patch 19 (white) is clipped", "patch 14 (green) is glaring", "patch 24 (black) is glaring",
                     "patch 8 (purplish blue) is shadowed"):
        assert f"warning  {sentence}, and left out" in printed
    assert difference(Capture.open(folder).manifest.color_matrix).mean() < 0.6
    left_out = {patch["name"]: patch["left_out"] for patch in section(folder)["kinds"][0]["patches"] if "left_out" in patch}
    assert left_out == {"white": "clipped", "green": "glaring", "black": "glaring", "purplish blue": "shadowed"}


@pytest.mark.long
def test_a_bright_patch_that_is_too_dark_may_be_clipped(relit, tmp_path):
    """A quarter of the light of white is cut off, at a level that nothing declares."""
    pixels = np.minimum(noisy(stain(picture(seen(), Pose(distance=700)), {8: -0.035}), noise=0.002), 0.33)
    told = relit.done("calibrate", "chart", shoot(tmp_path / "cap", [pixels])).out
    assert "patch 19 (white) is clipped or shadowed, and left out" in told and "patch 8 (purplish blue) is shadowed, and left out" in told


def half_shadow(shown, part, axis):
    middle = shown.corners.mean(axis=0)
    v, u = np.mgrid[: shown.pixels.shape[0], : shown.pixels.shape[1]]
    return shown.pixels * np.where((u, v)[axis] > middle[axis], part, 1.0)[..., None]


def other_colours():
    reflectance = np.random.default_rng(3).uniform(0.05, 0.9, (24, 3))
    return noisy(picture(seen(reflectance=reflectance), POSE).pixels)


UNREADABLE = {
    "no chart is found": lambda _: cv2.resize(np.random.default_rng(3).uniform(0, 0.8, (24, 32, 3)), (640, 480)),
    "the response is not linear": lambda shown: np.clip(noisy(shown.pixels, noise=0.001), 1e-4, 1) ** (1 / 2.2),
    "part of the chart lies in shadow": lambda shown: noisy(half_shadow(shown, 0.3, 0)),
    "half of it lies in shadow": lambda shown: noisy(half_shadow(shown, 0.6, 1)),
    "have not the colours of the chart": lambda _: other_colours(),
    "are lit and not clipped: check the exposure": lambda shown: np.minimum(shown.pixels * 18, 1),
    "12 of 24 patches of the chart can be used, 15 are needed": lambda shown: noisy(half_shadow(shown, 0.1, 1)),
}
"""What is said of pictures."""
LONG_SEARCHED = list(UNREADABLE)[-3:]
"""Those in which the chart is sought on, in up to 75 parts of the picture, after a place that shows no chart."""


@pytest.mark.long
@pytest.mark.parametrize(("words", "placed"), [
    *((words, words in LONG_SEARCHED) for words in UNREADABLE),
    *((words, False) for words in LONG_SEARCHED)])
def test_a_chart_that_cannot_be_read_is_refused_with_one_sentence_and_nothing_is_written(relit, tmp_path, words, placed):
    shown = picture(seen(), POSE)
    folder = shoot(tmp_path / "cap", [UNREADABLE[words](shown)], saturation=0.999)
    before = (folder / "capture.json").read_bytes()
    corners = ("--corners", ",".join(map(str, shown.corners.round(1).ravel()))) if placed else ()
    assert str(folder) in relit("calibrate", "chart", folder, *corners).refused(words)
    assert {path.name for path in folder.iterdir()} == {"0.exr", "capture.json"} and (folder / "capture.json").read_bytes() == before


def test_patches_under_light_of_two_colours_tell_no_matrix(relit, tmp_path):
    shown = picture(seen((1, 0.9, 0.01)), POSE)
    folder = shoot(tmp_path / "cap", [noisy(shown.pixels, noise=0.001)])
    corners = ",".join(map(str, shown.corners.round(1).ravel()))
    refused = relit("calibrate", "chart", folder, "--corners", corners).refused("needs light with red, green and blue")
    assert "differ in fewer than three colours" in refused


@pytest.mark.parametrize(("given", "words"), [
    (("--corners", "10,10,20,20,30,30,40,40"), "three of them lie on a line"),
    (("--corners", "1e9,0,0,1e9,5,5,1,1"), "lead out of the images, which are 640x480"),
    (("--corners", "300,200,310,200,310,210,300,210"), "pixels, 9 are needed"),
    (("--corners", "60,60,580,60,580,420,60,420"), "have not the colours of the chart"),
    pytest.param(("--chart", "sg"), "no chart is found", marks=pytest.mark.long),
    (("--reflectances", "nowhere.csv"), "nowhere.csv"),
])
def test_options_that_lead_nowhere(relit, tmp_path, given, words):
    folder = shoot(tmp_path / "cap", [picture(seen(), POSE, samples=1).pixels])
    relit("calibrate", "chart", folder, *given).refused(words)
    assert {path.name for path in folder.iterdir()} == {"0.exr", "capture.json"}


def lamp(irradiance=(1, 1, 1), polarization="none"):
    return {"type": "distant", "direction": [0, 0, 1], "irradiance": irradiance, "polarization": polarization}


@pytest.mark.long
def test_polarised_frames_and_lamps_of_other_colours_have_a_matrix_each(relit, tmp_path):
    """The filters before the lens in a cross-polarised frame have a colour; glare lies on other patches in each frame of one kind."""
    filtered, cold = (0.32, 0.30, 0.22), (0.7, 1.0, 1.4)
    lights = [lamp(), lamp((0.5, 0.5, 0.51)), lamp(), lamp(polarization="cross"), lamp((0.5, 0.8, 1.0)), {"type": "off"}]
    plain = picture(seen(), POSE)
    images = [stain(plain, {14: 0.2}), 0.5 * stain(plain, {15: 0.2}), stain(plain, {2: 0.3}),
              picture(seen(filtered), POSE).pixels, picture(seen(cold), POSE).pixels, np.zeros_like(plain.pixels)]
    room = 0.05 * np.array([1, 0.6, 0.3])  # the light of the room, which the frame without lamps shows too
    folder = shoot(tmp_path / "cap", [noisy(image + room, number, 0.002) for number, image in enumerate(images)], lights)
    other = shoot(tmp_path / "other", images, lights)
    printed = relit("calibrate", "chart", folder, "--apply-to", other).out
    assert printed.count("24 of 24 patches") == 3 and "cross-polarised light" in printed
    assert "2 frames declare lights with a colour" not in printed and "1 frames declare lights with a colour" in printed
    manifest = Capture.open(other).manifest
    own = [frame.color_matrix for frame in manifest.frames]
    assert own[:3] == [None] * 3 and own[5] is None and own[3] and own[4]
    for matrix, light in ((manifest.color_matrix, LIGHTS[0]), (own[3], filtered), (own[4], cold)):
        assert difference(matrix, light).mean() < 0.4
        assert difference(matrix, (1.3, 1, 0.45)).mean() > 4
    # the light of the room is subtracted in the colours of each frame
    edit_manifest(folder, **{key: value for key, value in json.loads((other / "capture.json").read_text()).items() if key != "schema"})
    correction = Correction.of(Capture.open(folder))
    u, v = plain.corners[3].astype(int)
    for frame in correction.capture.manifest.frames[:5]:
        patch = correction.apply(frame).pixels[v - 8 : v + 9, u - 8 : u + 9].mean(axis=(0, 1))
        np.testing.assert_allclose(patch / patch[1], REFLECTANCE[18] / REFLECTANCE[18, 1], atol=0.02)
    # a white balance takes the place of them all
    card = shoot(tmp_path / "card", [np.full((480, 640, 3), 0.3)])
    relit.done("calibrate", "white-balance", other, card / "0.exr")
    assert not any(frame.color_matrix for frame in Capture.open(other).manifest.frames)
    # and a kind of light that no frame with the chart has is named
    edit_manifest(other, frames=[{"image": "0.exr", "light": lamp(polarization="parallel")}])
    assert "shows the chart in such light" in relit("calibrate", "chart", folder, "--apply-to", other).refused("parallel-polarised light")


@pytest.mark.long
def test_lamps_of_several_primaries_have_a_matrix_each_and_a_narrow_one_is_refused(relit, tmp_path):
    """White, red and green, and broad amber LEDs; under deep red alone patches differ in fewer than three colours."""
    colours = {"white": (1.0, 1.0, 1.0), "red and green": (0.9, 0.7, 0.15), "amber": (1.0, 0.6, 0.25), "deep red": (1.0, 0.02, 0.004)}
    plain = picture(seen(), POSE)
    shown = {name: noisy(picture(seen(light), POSE).pixels, number, 0.002) for number, (name, light) in enumerate(colours.items())}
    broad = list(colours)[:3]
    folder = shoot(tmp_path / "broad", [shown[name] for name in broad], [lamp(colours[name]) for name in broad])
    assert relit("calibrate", "chart", folder).out.count("24 of 24 patches") == 3
    manifest = Capture.open(folder).manifest
    for frame, name in zip(manifest.frames, broad, strict=True):
        assert difference(frame.color_matrix or manifest.color_matrix, colours[name]).mean() < 0.5, name
    folder = shoot(tmp_path / "narrow", [shown["deep red"]], [lamp(colours["deep red"])])
    before = (folder / "capture.json").read_bytes()
    corners = ",".join(map(str, plain.corners.round(1).ravel()))
    relit("calibrate", "chart", folder, "--corners", corners).refused("needs light with red, green and blue")
    assert (folder / "capture.json").read_bytes() == before


@pytest.mark.long
@pytest.mark.parametrize("gap", [0.79, 0.94])
def test_charts_with_other_gaps_are_found(gap, tmp_path):
    shown = picture(seen(), POSE, patch=47 * gap)
    found = calibrate_chart(ChartRequest(capture=shoot(tmp_path / "cap", [noisy(shown.pixels)])))
    assert np.abs(found.corners - shown.corners).max() < 0.5 and np.nanmean(found.kinds[0].colors.after) < 1


def open_passport(folder, pose, light, seed):
    """Find the 24 patches of a Passport beside its other page; returns the largest error of a corner, CIEDE2000 after, and the matrix."""
    page = [each._replace(colour=EXPOSURE * np.array(light) * (CAMERA @ each.colour)) for each in other_page()]
    shown = picture(seen(light), pose, patch=47 * PASSPORT_PATCH, beside=page, size=(960, 720), seed=seed)
    found = calibrate_chart(ChartRequest(capture=shoot(folder, [noisy(shown.pixels, seed)]), chart=ChartKind.PASSPORT))
    return np.abs(found.corners - shown.corners).max(), np.nanmean(found.kinds[0].colors.after), Capture.open(folder).manifest.color_matrix


@pytest.mark.long
def test_a_passport_of_which_the_detector_fails_at_first_is_found(tmp_path):
    """OpenCV's detector raises an error of its own about the picture as it is."""
    off, after, _ = open_passport(tmp_path / "cap", Pose(3.4, -3.6, -11, 14.1, 94.4, 651.1), LIGHTS[0], 9000)
    assert off < 0.5 and after < 1


@pytest.mark.long
def test_an_open_passport_is_found_in_twenty_poses_and_three_lights(tmp_path):
    """In the third OpenCV's detector finds nothing in the whole picture."""
    for number, pose in enumerate(poses(20)):
        light = LIGHTS[number % 3]
        off, after, matrix = open_passport(tmp_path / str(number), pose._replace(y=pose.y + 70, distance=800), light, number)
        assert off < 0.5 and after < 1 and difference(matrix, light).mean() < 0.6, number


@pytest.mark.long
@pytest.mark.parametrize("pose", [Pose(12, -9, 4, distance=560), Pose(-22, 14, -9, 10, -8, 600), Pose(5, 33, 12, -12, 6, 620)])
def test_a_chart_of_140_patches(relit, tmp_path, pose):
    colours = seen(reflectance=reflectances(140))
    shown = picture(colours, pose, grid=(14, 10), pitch=24, patch=20, size=(960, 720))
    folder = shoot(tmp_path / "cap", [noisy(shown.pixels, noise=0.004)])
    relit("calibrate", "chart", folder, "--chart", "sg")
    np.testing.assert_allclose(section(folder)["corners"], shown.corners, atol=0.7)
    assert section(folder)["kinds"][0]["delta_e_2000"]["after"]["mean"] < 1
    assert difference(Capture.open(folder).manifest.color_matrix).mean() < 0.5
