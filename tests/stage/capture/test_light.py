"""Lights: directions become unit vectors, and what no light can be is refused."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import TypeAdapter, ValidationError

from stage.capture.light import DistantLight, ExtendedLight, Light, PointLight

component = st.floats(-1e6, 1e6).filter(lambda c: c == 0 or abs(c) > 1e-6)


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
