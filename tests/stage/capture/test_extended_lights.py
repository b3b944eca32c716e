"""Area sources of a manifest as arrays, and what is refused by name."""

import numpy as np
import pytest

from stage.capture.capture import Capture
from stage.capture.lighting import ExtendedLights, check_solvable, extended_lights
from stage.errors import ManifestError
from tests.scenes.captures import write_exr, write_manifest

TILT = np.eye(3)[[2, 0, 1]]


def source(*directions, radiance=((1.0, 0.5, 0.25),), solid_angle=0.1) -> dict:
    count = len(directions)
    radiance = list(radiance) * count if len(radiance) == 1 else list(radiance)
    return {"type": "extended", "directions": [list(map(float, d)) for d in directions], "radiance": [list(r) for r in radiance],
            "solid_angle": [solid_angle] * count}


def distant(direction) -> dict:
    return {"type": "distant", "direction": list(map(float, direction)), "irradiance": [2.0, 2.0, 2.0]}


def capture_of(folder, *lights) -> Capture:
    for index in range(len(lights)):
        write_exr(folder / f"{index}.exr", np.full((2, 2, 3), 0.5))
    write_manifest(folder, {"schema": "relit.capture/1", "name": "e",
                            "camera": {"projection": "orthographic", "resolution": [2, 2]},
                            "frames": [{"image": f"{i}.exr", "light": light} for i, light in enumerate(lights)]})
    return Capture.open(folder)


def test_shares_of_the_irradiance(tmp_path):
    bright = source(*TILT[:2], radiance=[(1.0, 0.5, 0.25), (3.0, 1.5, 0.75)])
    lights = extended_lights(capture_of(tmp_path, bright, {"type": "off"}, distant(TILT[1]), source(TILT[2])))
    assert np.allclose(lights.irradiance, [[0.4, 0.2, 0.1], [2, 2, 2], [0.1, 0.05, 0.025]])
    assert np.allclose(lights.share, [0.25, 0.75, 1, 1]) and lights.light.tolist() == [0, 0, 1, 2]
    assert np.allclose(lights.solid_angle, [0.1, 0.1, 0, 0.1]) and np.allclose(lights.direction, TILT[[0, 1, 1, 2]])


def test_samples_without_light_are_left_out(tmp_path):
    dark = source(*TILT, radiance=[(1, 1, 1), (0, 0, 0), (1, 1, 1)])
    lights = extended_lights(capture_of(tmp_path, dark, source(TILT[1]), source(TILT[2])))
    assert lights.light.tolist() == [0, 0, 1, 2]


def test_check_solvable_hands_them_over(tmp_path):
    assert isinstance(check_solvable(capture_of(tmp_path, *(source(d) for d in TILT))), ExtendedLights)


@pytest.mark.parametrize(("lights", "words"), [
    ([source(TILT[0]), source(TILT[1]), source(*TILT, radiance=[(1, 0, 0), (0, 1, 0), (0, 0, 1)])],
     "frames[2].light.radiance: its colour changes over the source"),
    ([source(TILT[0]), source(*TILT)], "frames: 2 lit by an extended or distant light: a normal"),
    ([source(TILT[0]), source(TILT[1]), source(TILT[0])], "all light comes from one plane"),
    ([source(d, radiance=((1, 1, 0),)) for d in TILT], "channel B is 0 for every light"),
    ([*(source(d) for d in TILT), {"type": "point", "position_m": [0, 0, 1], "intensity": [1, 1, 1]}],
     "frames[3].light: is point: beside extended lights a frame"),
    ([*(source(d) for d in TILT), {"type": "gradient", "axis": "x"}], "frames[3].light: is gradient: beside extended lights"),
])
def test_what_is_refused(tmp_path, lights, words):
    with pytest.raises(ManifestError) as refused:
        extended_lights(capture_of(tmp_path, *lights))
    assert words in str(refused.value)
