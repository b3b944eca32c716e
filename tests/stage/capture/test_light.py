"""Lights of a capture: their types, point lights placed for a surface, and extended ones as samples."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import TypeAdapter, ValidationError

from stage.capture.capture import Capture
from stage.capture.light import DistantLight, ExtendedLight, Light, PointLight
from stage.capture.lighting import ExtendedLights, check_solvable, extended_lights, lights_from_centre
from stage.capture.point_lights import place_lights
from stage.errors import ManifestError
from tests.scenes.captures import edit_frame, edit_manifest, make_scene, ring, write_capture, write_exr, write_manifest

component = st.floats(-1e6, 1e6).filter(lambda c: c == 0 or abs(c) > 1e-6)
TILT = np.eye(3)[[2, 0, 1]]
SIZE, PIXEL = 6, 0.01
CAMERA = {"projection": "orthographic", "resolution": [SIZE, SIZE], "pixel_size_m": PIXEL, "surface_z_m": 0.02}
LENS = {"projection": "perspective", "resolution": [SIZE, SIZE], "focal_px": [50, 50], "surface_z_m": -0.5}


@pytest.mark.long
@settings(deadline=None)
@given(st.tuples(component, component, component).filter(any))
def test_direction_is_kept_with_length_one(vector):
    light = DistantLight(type="distant", direction=vector, irradiance=(1, 1, 1))
    assert np.linalg.norm(light.direction) == pytest.approx(1, abs=1e-12)
    assert np.allclose(np.cross(light.direction, vector) / np.linalg.norm(vector), 0, atol=1e-12)
    assert np.dot(light.direction, vector) > 0


@pytest.mark.parametrize(("data", "words"), [
    ({"type": "distant", "direction": [0, 0, 0], "irradiance": [1, 1, 1]}, "zero length"),
    ({"type": "distant", "direction": [0, 0, float("inf")], "irradiance": [1, 1, 1]}, "finite"),
    ({"type": "distant", "direction": [0, 0, 1], "irradiance": [1, -1, 1]}, "greater than or equal to 0"),
    ({"type": "distant", "direction": [0, 0, 1], "irradiance": [0, 0, 0]}, "zero in every channel"),
    ({"type": "distant", "direction": [0, 1], "irradiance": [1, 1, 1]}, "direction"),
    ({"type": "point", "position_m": [0, 0, 1], "intensity": [1, 1, 1], "anisotropy": 1}, "needs axis"),
    ({"type": "point", "position_m": [0, 0, 1], "intensity": [1, 1, 1], "axis": [0, 0, 1], "anisotropy": -1}, "anisotropy"),
    ({"type": "extended", "directions": [[0, 0, 1]], "radiance": [[1, 1, 1]], "solid_angle": [0.1, 0.2]},
     "1 directions, 1 radiance and 2"),
    ({"type": "extended", "directions": [[0, 0, 1]], "radiance": [[1, 1, 1]] * 2, "solid_angle": [0.1]},
     "1 directions, 2 radiance and 1"),
    ({"type": "extended", "directions": [[0, 0, 1]], "radiance": [[0, 0, 0]], "solid_angle": [0.1]},
     "no radiance above 0"),
    ({"type": "extended", "directions": [], "radiance": [], "solid_angle": []}, "directions"),
    ({"type": "extended", "directions": [[0, 0, 1]], "radiance": [[1, 1, 1]], "solid_angle": [0]}, "solid_angle"),
    ({"type": "gradient", "axis": "w"}, "axis"),
    ({"type": "gradient", "axis": "x", "sign": 0}, "sign"),
    ({"type": "environment", "image": ""}, "image"),
    ({"type": "off", "direction": [0, 0, 1]}, "direction"),
])
def test_impossible_lights_are_refused(data, words):
    with pytest.raises(ValidationError, match=words):
        TypeAdapter(Light).validate_python(data)


def test_one_dark_channel_is_a_light():
    assert DistantLight(type="distant", direction=(0, 0, 1), irradiance=(1, 0, 0)).irradiance == (1, 0, 0)


def test_near_and_area_lights_keep_what_they_are_given():
    near = PointLight(type="point", position_m=(0.1, 0.2, 0.3), intensity=(1, 2, 3), axis=(0, 0, -2), anisotropy=0.5)
    assert near.axis == (0, 0, -1) and near.position_m == (0.1, 0.2, 0.3)
    area = ExtendedLight(type="extended", directions=((0, 3, 4),), radiance=((1, 1, 1),), solid_angle=(0.1,))
    assert np.allclose(area.directions, [(0, 0.6, 0.8)])


def source(*directions, radiance=((1.0, 0.5, 0.25),), solid_angle=0.1) -> dict:
    count = len(directions)
    radiance = list(radiance) * count if len(radiance) == 1 else list(radiance)
    return {"type": "extended", "directions": [list(map(float, d)) for d in directions], "radiance": [list(r) for r in radiance],
            "solid_angle": [solid_angle] * count}


def distant(direction) -> dict:
    return {"type": "distant", "direction": list(map(float, direction)), "irradiance": [2.0, 2.0, 2.0]}


def capture_of(folder, *lights, size: int = 2) -> Capture:
    for index in range(len(lights)):
        write_exr(folder / f"{index}.exr", np.full((size, size, 3), 0.5))
    write_manifest(folder, {"schema": "relit.capture/1", "name": "e",
                            "camera": {"projection": "orthographic", "resolution": [size, size]},
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


def point(position, **more):
    return {"type": "point", "position_m": list(position), "intensity": [1, 2, 3], **more}


@pytest.fixture
def folder(tmp_path):
    """Four point lights 0.2 m from the centre of the surface."""
    write_capture(tmp_path, make_scene(size=SIZE, lights=4), mask=None, camera=CAMERA)
    for index, way in enumerate(ring(4)):
        edit_frame(tmp_path, index, light=point(0.2 * way + [0, 0, 0.02]))
    return tmp_path


def refused(folder) -> str:
    with pytest.raises(ManifestError) as caught:
        check_solvable(Capture.open(folder))
    text = str(caught.value)
    assert text.count(str(folder)) == 1 and "\n" not in text
    return text


def test_places_strengths_and_what_the_centre_sees(folder):
    edit_frame(folder, 1, light=point([0, 0, 0.52], axis=[0.6, 0, -0.8], anisotropy=2))
    edit_frame(folder, 2, light={"type": "distant", "direction": [0, 3, 4], "irradiance": [5, 6, 7]})
    lights = check_solvable(Capture.open(folder))
    assert np.allclose(lights.centre, [0, 0, 0.02])
    assert np.allclose(lights.place[:3], [[0, 0, 0.22, 1], [0, 0, 0.52, 1], [0, 0.6, 0.8, 0]])
    assert np.allclose(lights.strength[[1, 2]], [[1, 2, 3], [5, 6, 7]])
    assert np.allclose(lights.lobe[1], [0.6, 0, -0.8, 2]) and not lights.lobe[[0, 2, 3]].any()
    assert np.allclose(lights.direction, [[0, 0, 1], [0, 0, 1], [0, 0.6, 0.8], ring(4)[3]])
    assert np.allclose(lights.irradiance[1], np.array([1, 2, 3]) * 0.8**2 / 0.5**2)
    assert np.allclose(lights.irradiance[[0, 3]], np.array([1, 2, 3]) / 0.2**2) and np.allclose(lights.irradiance[2], [5, 6, 7])
    far = lights_from_centre(Capture.open(folder))
    assert np.array_equal(far.direction, lights.direction) and np.array_equal(far.irradiance, lights.irradiance)


def test_an_axis_without_anisotropy_changes_nothing(folder):
    before = place_lights(Capture.open(folder))
    edit_frame(folder, 0, light=point([0, 0, 0.22], axis=[1, 0, 0]))
    assert np.array_equal(place_lights(Capture.open(folder)).irradiance, before.irradiance)


@pytest.mark.parametrize(("camera", "field"), [
    ({**CAMERA, "pixel_size_m": None}, "pixel_size_m"), ({**LENS, "surface_z_m": None}, "surface_z_m"),
])
def test_a_camera_without_scale(folder, camera, field):
    edit_manifest(folder, camera={key: value for key, value in camera.items() if value is not None})
    assert f"camera.{field}: is missing: near lights need the place of the" in refused(folder)


@pytest.mark.parametrize("position", [[0.01, 0.01, -0.3], [0, 0, 0.02], [0.015, -0.02, 0.029]])
def test_lights_inside_the_object_or_nearer_than_a_pixel(folder, position):
    edit_frame(folder, 1, light=point(position))
    edit_frame(folder, 3, light=point(position))
    text = refused(folder)
    assert "frames[1], frames[3]: light.position_m: 2 of 4 lights lie" in text
    assert "z = 0.02 m" in text


def test_a_perspective_camera(folder):
    edit_manifest(folder, camera=LENS)
    for index, way in enumerate(ring(4)):
        edit_frame(folder, index, light=point(0.2 * way + [0, 0, -0.5]))
    lights = check_solvable(Capture.open(folder))
    assert np.allclose(lights.centre, [0, 0, -0.5]) and np.allclose(lights.direction, ring(4))
    edit_frame(folder, 1, light=point([0.02, 0, -0.7]))
    assert "frames[1]: light.position_m: 1 of 4 lights lie within the" in refused(folder)
    edit_frame(folder, 1, light=point([0.2, 0, -0.7]))
    assert len(check_solvable(Capture.open(folder)).place) == 4
    edit_frame(folder, 1, light=point([0, 0, 0.1]))  # behind the camera: it does not hide what it sees
    assert len(check_solvable(Capture.open(folder)).place) == 4


@pytest.mark.parametrize(("moved", "words"), [
    (lambda way: [10 * way[0] + 1, way[1], -0.2], "0 of 4 lights lie in front of the surface (z = 0.02 m, +z is"),
    (lambda way: 0.0002 * way + [0, 0, 0.3], "frames[].light.position_m: the near lights lie within 0.00017 m, and the object is"),
], ids=["a sign turned round", "another unit"])
def test_lights_at_impossible_places_are_refused(folder, moved, words):
    for index, way in enumerate(ring(4)):
        edit_frame(folder, index, light=point(moved(way)))
    assert words in refused(folder)


def test_what_distant_lights_are_refused_for(folder):
    for index, x in enumerate((-0.2, -0.1, 0.1, 0.2)):
        edit_frame(folder, index, light=point([x, 0, 0.3]))
    assert "frames[].light.position_m: all 4 lights lie in one plane" in refused(folder)
    for index, way in enumerate(ring(4)):
        edit_frame(folder, index, light={**point(0.2 * way + [0, 0, 0.02]), "intensity": [1, 0, 1]})
    assert "frames[].light.intensity: channel G is 0 for every light" in refused(folder)
    for index in (1, 2):
        edit_frame(folder, index, light={"type": "off"})
    assert "2 lit by a distant or point light: a normal needs three or" in refused(folder)
    edit_frame(folder, 1, light={"type": "gradient", "axis": "x"})
    assert "frames[1].light: is gradient: this needs distant or point" in refused(folder)
