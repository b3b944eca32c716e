"""The camera: rays through pixels, the inverse of its distortion, and points of a height map."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from stage.capture.camera import Camera, Distortion


def perspective(**changes):
    fields = {"projection": "perspective", "resolution": (40, 30), "focal_px": (50.0, 55.0), "principal_px": (21.0, 14.0)}
    return Camera(**{**fields, **changes})


coefficient = st.floats(-0.05, 0.05)
tangential = st.floats(-0.005, 0.005)
plane = st.floats(-0.5, 0.5)


@pytest.mark.long
@settings(deadline=None)
@given(k=st.tuples(coefficient, coefficient, coefficient), p=st.tuples(tangential, tangential), x=plane, y=plane)
def test_undo_is_the_inverse_of_apply(k, p, x, y):
    lens = Distortion(model="brown_conrady", k=k, p=p)
    x, y = np.array([x]), np.array([y])
    back = lens.undo(*lens.apply(x, y))
    # what the fixed point leaves after its iterations: its contraction is below 0.25 for these lenses, and 0.25^20 = 1e-12
    assert np.allclose(back, (x, y), rtol=0, atol=1e-12)


def test_distortion_is_opencvs():
    # cv::projectPoints' own formula, written out once more
    k1, k2, k3, p1, p2, x, y = 0.1, -0.02, 0.003, 0.004, -0.005, 0.3, -0.2
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    expected = (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y)
    lens = Distortion(model="brown_conrady", k=(k1, k2, k3), p=(p1, p2))
    assert np.allclose(lens.apply(np.array(x), np.array(y)), expected, rtol=1e-14)


@pytest.mark.parametrize("camera", [
    perspective(distortion=Distortion(model="brown_conrady", k=(-0.1, 0.02, 0.0), p=(0.001, -0.002))), perspective(principal_px=None),
    Camera(projection="orthographic", resolution=(40, 30), pixel_size_m=0.01, principal_px=(3.0, 8.5)),
    Camera(projection="orthographic", resolution=(40, 30))])
def test_points_are_seen_at_their_pixels(camera):
    u, v = np.meshgrid(np.arange(40) + 0.5, np.arange(30) + 0.5)
    found = camera.image_coordinates(camera.points(np.linspace(-3, -2, 1200).reshape(30, 40)))
    assert np.allclose(found, (u, v), rtol=0, atol=2e-5)  # float32 points


def test_perspective_points_lie_on_their_rays_in_front_of_the_camera():
    points = perspective().points(np.full((30, 40), -2.0))
    assert points.dtype == np.float32
    # pixel (row 3, column 5) is at u, v = 5.5, 3.5; above the principal point is up, left of it is -x
    assert np.allclose(points[3, 5], (2 * (5.5 - 21) / 50, -2 * (3.5 - 14) / 55, -2), rtol=1e-6)


def test_orthographic_points_are_metric_or_in_pixels():
    metric = Camera(projection="orthographic", resolution=(4, 2), pixel_size_m=0.01)
    assert metric.metric
    assert np.allclose(metric.points(np.zeros((2, 4)))[0, 3], (0.015, 0.005, 0))
    bare = Camera(projection="orthographic", resolution=(4, 2))
    assert not bare.metric
    assert np.allclose(bare.points(np.ones((2, 4)))[1, 0], (-1.5, -0.5, 1))


@pytest.mark.parametrize("camera", [
    perspective(), perspective(distortion=Distortion(model="brown_conrady", k=(-0.1, 0.02, 0.0), p=(0.001, -0.002))),
    Camera(projection="orthographic", resolution=(40, 30), pixel_size_m=0.01, principal_px=(3.0, 8.5))])
def test_rows_of_the_image_are_those_of_the_whole(camera):
    height = -1 - np.arange(1200.0).reshape(30, 40) / 1200
    for rows, whole in zip(camera.plane_views(7, 5), camera.plane_coordinates(), strict=True):
        np.testing.assert_array_equal(rows, whole[7:12])
    np.testing.assert_array_equal(camera.points(height[7:], 7), camera.points(height)[7:])


@pytest.mark.parametrize(("changes", "words"), [
    ({"focal_px": None}, "focal_px is missing"),
    ({"pixel_size_m": 0.1}, "pixel_size_m is for orthographic"),
    ({"surface_z_m": 1.0}, "must be negative"),
    ({"projection": "orthographic"}, "focal_px is for perspective"),
    ({"resolution": (0, 3)}, "resolution"),
    ({"focal_px": (0.0, 1.0)}, "focal_px"),
    ({"projection": "fisheye"}, "projection"),
    ({"focal": 3}, "focal"),
])
def test_contradictions_are_refused(changes, words):
    with pytest.raises(ValidationError, match=words):
        perspective(**changes)


@pytest.mark.parametrize("camera", [
    Camera(projection="orthographic", resolution=(7, 5), pixel_size_m=0.01),
    Camera(projection="perspective", resolution=(7, 5), focal_px=(9.0, 9.5), principal_px=(3.0, 2.0),
           distortion=Distortion(model="brown_conrady", k=(0.1, 0.01, 0.0), p=(0.001, 0.002))),
], ids=["orthographic", "perspective"])
def test_points_of_single_pixels_are_those_of_the_image(camera):
    height = -1.0 - np.arange(35, dtype=np.float32).reshape(5, 7) / 50
    pixels = np.array([0, 6, 12, 34])
    assert np.array_equal(camera.points_at(pixels, height.reshape(-1)[pixels]), camera.points(height).reshape(-1, 3)[pixels])
