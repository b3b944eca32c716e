"""What else a mirror ball shows: windows and lamps of the room, a second lamp, something beside the lamp, a rim as bright as the wall."""

import json
from functools import cache

import numpy as np
import pytest

from service.calibrate.lights import mirror_ball
from service.requests.base.option_values import Circle
from service.requests.calibrate import MirrorBallRequest
from stage.errors import CalibrationError
from tests.marks import first_short
from tests.reference.balls import render
from tests.scenes.captures import angles_degrees, write_lit
from tests.service.calibrate.solvers.balls import spread, unit

WIDTH, HEIGHT, RADIUS = 200, 160, 60
CENTRE = 102.0, 77.0
GEOMETRY = {"centre": np.array([2.0, 3.0, 0.0]), "radius": float(RADIUS), "pixel_size": 1.0}
NAMED = [Circle(u=CENTRE[0], v=CENTRE[1], radius_px=RADIUS)]
DIRECTIONS = spread(6, 0.2)
WINDOW = unit(0.7, 0.4, 0.4)


def disc(seen, direction, degrees):
    return (seen @ direction > np.cos(np.radians(degrees))).astype(float)


@cache
def image(lamps, ambient=0.03):
    """A ball that mirrors lamps, each (direction, degrees, radiance), and a room that grows brighter upwards."""
    def shade(point, normal, viewer):
        seen = 2 * (normal * viewer).sum(-1, keepdims=True) * normal - viewer
        room = ambient * (1 + 0.5 * np.clip(seen[:, 1] + 0.3, 0, 1) + 0.3 * np.sin(4 * seen[:, 0]))
        return room + sum(radiance * disc(seen, np.array(direction), degrees) for direction, degrees, radiance in lamps)
    return render(shade, width=WIDTH, height=HEIGHT, samples=4, background=1.2 * ambient, **GEOMETRY)[0]


def lamp(direction, degrees=2.0, radiance=1.0):
    return tuple(direction), degrees, radiance


def write(folder, images, **camera):
    random = np.random.default_rng(2)
    noisy = (np.clip(values + 0.001 * random.normal(size=values.shape), 0, 1) for values in images)
    placeholder = {"type": "distant", "direction": [0, 0, 1], "irradiance": [1, 1, 1]}
    return write_lit(folder, noisy, [placeholder] * len(images), saturation=0.99,
                     camera={"projection": "orthographic", "resolution": [WIDTH, HEIGHT], **camera})


def measured(folder, circles=NAMED):
    mirror_ball(MirrorBallRequest(capture=folder, circles=circles))
    lights = json.loads((folder / "calibration.json").read_text())["mirror-ball"]["lights"]
    errors = angles_degrees(np.array([light["direction"] for light in lights]), DIRECTIONS)
    return errors, np.array([light["uncertainty_degrees"] for light in lights]), [light["flags"] for light in lights]


@first_short("room", [lamp(WINDOW, 12.0, 0.6), lamp(WINDOW, 12.0, 5.0), lamp(WINDOW, 3.0, 5.0)],
             ids=["window", "saturated window", "lamp of the room"])
def test_a_light_of_the_room_is_not_the_lamp(tmp_path, room):
    """A light of the room is brighter or larger than the lamp, and stands still from frame to frame; a pixel is 2° of reflection."""
    errors, _, flags = measured(write(tmp_path / "ball", [image((lamp(d, radiance=3.0), room)) for d in DIRECTIONS]))
    assert errors.max() < 1.0
    assert room[2] < 3.0 or all("another spot stands still" in each for each in flags)


def test_the_same_lamp_in_every_frame_is_refused(tmp_path):
    folder = write(tmp_path / "ball", [image((lamp(DIRECTIONS[0]),)) for _ in DIRECTIONS])
    before = (folder / "capture.json").read_text()
    with pytest.raises(CalibrationError, match="stands still in all frames"):
        mirror_ball(MirrorBallRequest(capture=folder, circles=NAMED))
    assert (folder / "capture.json").read_text() == before


@pytest.mark.long
def test_two_lamps_alike_are_as_unsure_as_they_differ(tmp_path):
    """The second frame shows the first lamp too, .9 as bright, and the third a half as bright in its peak: that is no rival."""
    images = [image((lamp(d),)) for d in DIRECTIONS]
    images[1] = image((lamp(DIRECTIONS[1], radiance=0.9), lamp(DIRECTIONS[0], radiance=0.95)))
    images[2] = image((lamp(DIRECTIONS[2], radiance=0.9), lamp(DIRECTIONS[0], radiance=0.3)))
    errors, sure_to, flags = measured(write(tmp_path / "ball", images))
    assert errors[1] > 20 and errors[1] < 2 * sure_to[1] and flags[1] == ["several spots"]
    assert np.delete(errors, 1).max() < 1.0 and np.delete(sure_to, 1).max() < 10


@pytest.mark.long
def test_what_mirrors_the_lamp_beside_it_is_held_by_sigma(tmp_path):
    """A wall of 12° beside the third lamp, a third as bright, runs into its spot."""
    images = [image((lamp(d),)) for d in DIRECTIONS]
    aside = unit(*(DIRECTIONS[2] + 0.2 * unit(0.3, 0.9, 0.1)))
    images[2] = image((lamp(DIRECTIONS[2]), lamp(aside, 12.0, 0.3)))
    errors, sure_to, flags = measured(write(tmp_path / "ball", images))
    assert errors[2] > 3 and errors[2] < 2 * sure_to[2] and "wider than the others" in flags[2]
    assert np.delete(errors, 2).max() < 1.0


@first_short("ambient", [0.03, 0.1])
def test_the_outline_is_found_where_the_rim_is_as_bright_as_the_wall(tmp_path, ambient):
    """The room in the ball has steeper slopes than parts of its rim, but no sharp ones. σ takes the outline as known to a pixel."""
    errors, sure_to, _ = measured(write(tmp_path / "ball", [image((lamp(d),), ambient) for d in DIRECTIONS]), circles=[])
    assert (errors < sure_to).all() and errors.max() < 2.0
