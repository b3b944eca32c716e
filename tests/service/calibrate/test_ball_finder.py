"""Balls that nobody points at: found among other round and bright things, or refused with a sentence."""

import json

import cv2
import numpy as np
import pytest

from service.calibrate.lights import grey_ball, light_positions, mirror_ball
from service.errors import RequestError
from service.requests.calibrate import GreyBallRequest, LightPositionsRequest, MirrorBallRequest
from tests.reference.balls import lambertian, render
from tests.scenes.captures import angles_degrees, files_in, write_lit
from tests.service.calibrate.solvers.balls import spread

pytestmark = pytest.mark.long

WIDTH, HEIGHT = 320, 240
PLACEHOLDER = {"type": "distant", "direction": [0, 0, 1], "irradiance": [1, 1, 1]}
DIRECTIONS = spread(12, 0.15)
RADIUS = 58.0
CAMERAS = {
    "orthographic": ({"projection": "orthographic"}, {"centre": np.array([-47.3, 21.8, 0.0]), "radius": RADIUS, "pixel_size": 1.0}),
    # the same size, 12 degrees off the axis: the outline is an ellipse
    "perspective": ({"projection": "perspective", "focal_px": [400.0, 400.0]},
                    {"centre": np.array([-0.17, 0.07, -0.8]), "radius": 0.12, "focal": 400.0}),
}


def chrome(direction):
    """A mirror in a room: a bright floor of tiles, a dim ceiling, and the lamp of 2 degrees."""
    def shade(point, normal, viewer):
        seen = 2 * (normal * viewer).sum(-1, keepdims=True) * normal - viewer
        tiles = 0.12 + 0.06 * np.sign(np.sin(9 * seen[:, 0]) * np.sin(9 * seen[:, 2]))
        room = np.where(seen[:, 1] < -0.2, tiles, 0.05 + 0.03 * seen[:, 1])
        return room + 4.0 * np.exp((seen @ direction - 1) / np.radians(2.0) ** 2)
    return shade


def room(number, seed=0):
    """What stands behind the ball: a wall, a white disc, a striped box, and a glossy spot that stays where it is."""
    rows, cols = np.mgrid[:HEIGHT, :WIDTH]
    wall = 0.3 + 0.1 * cols / WIDTH + 0.05 * (number % 3)
    disc = (cols - 250) ** 2 + (rows - 60) ** 2 < 35**2
    box = (cols > 210) & (rows > 140)
    values = np.where(disc, 0.6 + 0.02 * number, np.where(box, 0.2 + 0.1 * np.sign(np.sin(cols / 5)), wall))
    return np.where((cols - 255) ** 2 + (rows - 180) ** 2 < 9, 3.0, values)


def photograph(folder, camera, shade_of, *, hidden=False, ball=True, noise=0.005, widened=1.0, moved_px=0, declared=None):
    """The capture of a ball in the room, a book before its lower right side where `hidden`, in images that were widened by a factor, and
    the last third of them shifted; `declared`: another camera in the manifest."""
    lens, place = CAMERAS[camera]
    random, images = np.random.default_rng(3), []
    for number, direction in enumerate(DIRECTIONS):
        image, coverage = render(shade_of(direction), width=WIDTH, height=HEIGHT, samples=3, **place)
        behind = room(number)
        values = image + (1 - coverage) * behind if ball else behind
        if hidden:
            rows, cols = np.mgrid[:HEIGHT, :WIDTH]
            values = np.where((cols > 130) & (rows > 145), 0.15 + 0.02 * (cols % 7), values)
        values = np.roll(values, moved_px, axis=1) if 3 * number >= 2 * len(DIRECTIONS) else values
        images.append(cv2.resize(np.maximum(values + noise * random.normal(size=values.shape), 0), None, fx=widened, fy=1.0))
    camera = {"resolution": list(images[0].shape[::-1]), **(declared or lens)}
    return write_lit(folder, images, [PLACEHOLDER] * len(images), camera=camera)


def measured(folder):
    frames = json.loads((folder / "capture.json").read_text())["frames"]
    return np.array([frame["light"]["direction"] for frame in frames])


@pytest.mark.parametrize(("camera", "hidden"), [("orthographic", False), ("orthographic", True), ("perspective", False)])
def test_a_chrome_ball_is_found_and_gives_directions(tmp_path, camera, hidden):
    """Off the centre, among other round and bright things, half behind a book in one case, with noise."""
    folder = photograph(tmp_path / "capture", camera, chrome, hidden=hidden)
    mirror_ball(MirrorBallRequest(capture=folder, drop_failed=hidden))
    kept = [int(frame["image"][:3]) for frame in json.loads((folder / "capture.json").read_text())["frames"]]
    error = angles_degrees(measured(folder), DIRECTIONS[kept])
    if hidden:  # lamps whose reflection the book hides are wrong or left out
        error = error[[i for i, k in enumerate(kept) if not (DIRECTIONS[k][0] > -0.1 and DIRECTIONS[k][1] < 0.1)]]
    assert len(error) >= 5 and error.max() < 0.5, error


def test_a_ball_on_a_bright_table_is_found_and_gives_directions(tmp_path):
    """Seen from above, half of it mirrors the table, which hid the lamp: the circle within that ring gave directions 8 to 29° off, 5 σ."""
    def above_a_table(direction):
        def shade(point, normal, viewer):
            seen = 2 * (normal * viewer).sum(-1, keepdims=True) * normal - viewer
            lamp = np.clip(2.5 - np.degrees(np.arccos(np.clip(seen @ direction, -1, 1))), 0, 1)
            return np.minimum(np.where(seen[:, 2] < -0.1, 0.6, 0.3 + 0.05 * seen[:, 0]) + 4 * lamp, 1.0)
        return shade

    folder = photograph(tmp_path / "capture", "orthographic", above_a_table)
    mirror_ball(MirrorBallRequest(capture=folder))
    error = angles_degrees(measured(folder), DIRECTIONS)
    assert error.max() < 0.8, error


def test_a_grey_ball_is_found_and_gives_directions(tmp_path):
    folder = photograph(tmp_path / "capture", "orthographic", lambda direction: lambertian(direction, albedo=0.6, irradiance=2.0))
    grey_ball(GreyBallRequest(capture=folder, refine_direction=True))
    error = angles_degrees(measured(folder), DIRECTIONS)
    assert error.max() < 0.5, error


@pytest.mark.parametrize(("kind", "shade"), [("mirror", lambda d: lambertian(d, albedo=0.6, irradiance=2.0)), ("grey", chrome)])
def test_a_ball_of_another_kind_is_refused(tmp_path, kind, shade):
    folder = photograph(tmp_path / "capture", "orthographic", shade)
    before = files_in(folder)
    with pytest.raises(RequestError, match=f"no {kind} ball is found in the images"):
        if kind == "mirror":
            mirror_ball(MirrorBallRequest(capture=folder))
        else:
            grey_ball(GreyBallRequest(capture=folder, refine_direction=True))
    assert files_in(folder) == before


def test_no_ball_is_refused(tmp_path):
    folder = photograph(tmp_path / "capture", "orthographic", chrome, ball=False)
    with pytest.raises(RequestError, match="no mirror ball is found"):
        mirror_ball(MirrorBallRequest(capture=folder))
    with pytest.raises(RequestError, match="no grey ball is found"):
        grey_ball(GreyBallRequest(capture=folder))


LAMPS = np.array([(0.3, 0.25, 0.5), (-0.35, 0.2, 0.4), (0.1, -0.3, 0.45), (-0.2, -0.2, 0.6), (0.45, 0.0, 0.35), (0.0, 0.4, 0.4)])
BALLS = (np.array([-0.09, 0.02, 0.0]), np.array([0.10, -0.03, 0.0]))  # metres; a millimetre a pixel
BALL_M = 0.045


def near_lamp(lamp, brightness=4.0):
    """A mirror that shows a lamp of 2 cm in the same room."""
    def shade(point, normal, viewer):
        seen = 2 * (normal * viewer).sum(-1, keepdims=True) * normal - viewer
        way = lamp - point
        far = np.linalg.norm(way, axis=-1)
        off = 1 - (seen * way).sum(-1) / far
        tiles = 0.12 + 0.06 * np.sign(np.sin(9 * seen[:, 0]) * np.sin(9 * seen[:, 2]))
        return np.where(seen[:, 1] < -0.2, tiles, 0.05) + brightness * np.exp(-2 * off / (0.02 / far) ** 2)
    return shade


def two_balls(folder, radii=(BALL_M, BALL_M)):
    random, images = np.random.default_rng(4), []
    for number, lamp in enumerate(LAMPS):
        values = room(number)
        for centre, radius in zip(BALLS, radii, strict=True):
            image, coverage = render(near_lamp(lamp), width=WIDTH, height=HEIGHT, samples=3, centre=centre, radius=radius, pixel_size=0.001)
            values = image + (1 - coverage) * values
        images.append(np.maximum(values + 0.005 * random.normal(size=values.shape), 0))
    camera = {"resolution": [WIDTH, HEIGHT], "projection": "orthographic", "pixel_size_m": 0.001}
    return write_lit(folder, images, [PLACEHOLDER] * len(images), camera=camera)


def test_two_chrome_balls_are_found_and_give_positions(tmp_path):
    """A tenth of a pixel of outline or spot is 0.25°, 2 mm at 0.5 m; the rays meet at 20° to 30°, which doubles it and more."""
    folder = two_balls(tmp_path / "capture")
    light_positions(LightPositionsRequest(capture=folder))
    frames = json.loads((folder / "capture.json").read_text())["frames"]
    error = np.linalg.norm([frame["light"]["position_m"] for frame in frames] - LAMPS, axis=1)
    assert error.max() < 0.01, error
    report = json.loads((folder / "calibration.json").read_text())["light-positions"]
    assert len(report["balls"]) == 2
    sigma = np.array([light["uncertainty_m"] for light in report["lights"]])
    assert (error < 3 * sigma).all()


def test_one_ball_does_not_place_lights(tmp_path):
    folder = photograph(tmp_path / "capture", "orthographic", chrome)
    before = files_in(folder)
    with pytest.raises(RequestError, match=r"1 mirror ball is found in the images .* near lights need two"):
        light_positions(LightPositionsRequest(capture=folder))
    assert files_in(folder) == before


@pytest.mark.parametrize("widened", [1.08, 1.0, 1.15])
def test_a_ball_whose_picture_is_an_ellipse_is_said_and_held(relit, tmp_path, widened):
    """As of images that were resized in one direction: its circle is 2.3 or 4.4 px off where the ellipse is farthest from it."""
    folder = photograph(tmp_path / "capture", "orthographic", chrome, widened=widened)
    outcome = relit.done("calibrate", "mirror-ball", folder)
    assert ("its outline is an ellipse" in outcome.out.replace("\n", " ")) == (widened > 1)
    stated = [light["uncertainty_degrees"] for light in json.loads((folder / "calibration.json").read_text())["mirror-ball"]["lights"]]
    error = angles_degrees(measured(folder), DIRECTIONS)
    assert (error / stated).max() < 2 and (error.mean() < 0.5 or widened > 1), error / stated


@pytest.mark.parametrize(("camera", "kind", "circle"), [
    ("orthographic", "mirror", "115.7,100.2,59"), ("orthographic", "mirror", "117,97,73"), ("perspective", "grey", "78.8,84.8,60.7")])
def test_a_circle_that_lies_aside_is_named_with_the_one_that_is_there(relit, tmp_path, camera, kind, circle):
    shade = chrome if kind == "mirror" else lambda direction: lambertian(direction, albedo=0.6, irradiance=2.0)
    folder = photograph(tmp_path / "capture", camera, shade)
    outcome = relit.done("calibrate", f"{kind}-ball", folder, "--ball", circle, *(["--refine-direction"] if kind == "grey" else []))
    report = json.loads((folder / "calibration.json").read_text())[f"{kind}-ball"]
    sentence, = report["warnings"]
    assert sentence in outcome.out.replace("\n", " ") and "px from the outline" in sentence
    stated = np.array([light["uncertainty_degrees"] for light in report["lights"]])
    error = angles_degrees(measured(folder), DIRECTIONS)
    assert error.mean() > 3 and (error / stated).max() < 2.5 and np.median(error / stated) < 1.5
    u, v, radius = map(float, sentence.split("there, ")[1].split(":")[0].split(","))
    relit.done("calibrate", f"{kind}-ball", folder, "--ball", f"{u},{v},{radius}", *(["--refine-direction"] if kind == "grey" else []))
    assert angles_degrees(measured(folder), DIRECTIONS).mean() < 0.25 * error.mean()
    assert json.loads((folder / "calibration.json").read_text())[f"{kind}-ball"]["warnings"] == []


@pytest.mark.parametrize(("changes", "sentence"), [
    ({"moved_px": 4}, "px aside from 009.exr to 011.exr of where it lies from 000.exr to 002.exr"),
    ({"camera": "perspective", "declared": {"projection": "orthographic"}}, "as a perspective camera sees it 13° off its axis")])
def test_a_ball_that_moved_or_is_seen_from_aside_is_said_and_held(relit, tmp_path, changes, sentence):
    folder = photograph(tmp_path / "capture", **{"camera": "orthographic", **changes}, shade_of=chrome)
    outcome = relit.done("calibrate", "mirror-ball", folder)
    report = json.loads((folder / "calibration.json").read_text())["mirror-ball"]
    error = angles_degrees(measured(folder), DIRECTIONS)
    assert sentence in outcome.out.replace("\n", " ") and len(report["warnings"]) == 1
    assert error.max() > 5 and (error / [light["uncertainty_degrees"] for light in report["lights"]]).max() < 1.5
