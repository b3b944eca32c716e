"""Point lights of a capture as arrays, and the places where no light can be."""

import numpy as np
import pytest

from stage.capture.capture import Capture
from stage.capture.lighting import check_solvable, lights_from_centre
from stage.capture.point_lights import place_lights
from stage.errors import ManifestError
from tests.scenes.captures import edit_frame, edit_manifest, make_scene, ring, write_capture

SIZE, PIXEL = 6, 0.01
CAMERA = {"projection": "orthographic", "resolution": [SIZE, SIZE], "pixel_size_m": PIXEL, "surface_z_m": 0.02}
LENS = {"projection": "perspective", "resolution": [SIZE, SIZE], "focal_px": [50, 50], "surface_z_m": -0.5}


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


def test_beside_the_object_a_light_may_stand_lower_than_it(folder):
    edit_frame(folder, 1, light=point([0.2, 0, -0.1]))
    assert len(check_solvable(Capture.open(folder)).place) == 4


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


def test_a_sign_turned_round_is_seen(folder):
    for index, way in enumerate(ring(4)):
        edit_frame(folder, index, light=point([10 * way[0] + 1, way[1], -0.2]))
    assert "0 of 4 lights lie in front of the surface (z = 0.02 m, +z is" in refused(folder)


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
