"""Samples of lights: what they send in sum, and the irradiance of area lights in closed form."""

import numpy as np
import pytest

from kernels.errors import ArrayError
from kernels.relight.model import sources
from tests.kernels.relight.surfaces import facing, radiance
from tests.kernels.scenes import angle_degrees
from tests.reference.shading import polygon_irradiance

COLOUR = np.array([1.0, 2.0, 0.5])


def irradiance(given, device, *, normal=(0, 0, 1), position=(0, 0, 0)):
    """[3] at a Lambertian pixel of albedo one."""
    return np.pi * radiance(facing(1, normal=normal, position=position), given, device)[:3, 0]


@pytest.mark.parametrize("distance, tolerance", [(10.0, 1e-3), (3.0, 1e-3), (1.5, 2e-3)])
@pytest.mark.parametrize("lean_degrees", [0.0, 25.0])
def test_a_sphere_lights_as_its_centre_does(distance, tolerance, lean_degrees, device):
    """π L (R / d)² cos θ, for any sphere wholly above the horizon. Tolerance: of the 512 samples those at the rim
    of what faces the pixel, one in 13, count a little less or more than their part that does: by a quarter of a sample at a cosine of
    0.08 or below, at random. Closer by fewer face it."""
    lean = np.radians(lean_degrees)
    centre = np.array([0.1, -0.2, 0.3]) + distance * np.array([np.sin(lean), 0, np.cos(lean)])
    got = irradiance(sources.sphere(centre, 1.0, COLOUR), device, position=(0.1, -0.2, 0.3))
    np.testing.assert_allclose(got, np.pi * COLOUR / distance**2 * np.cos(lean), rtol=tolerance)


def test_a_sphere_is_the_same_from_all_sides(device):
    got = [irradiance(sources.sphere(3 * side, 1.0, COLOUR), device, normal=side)[0] for side in np.concatenate([np.eye(3), -np.eye(3)])]
    np.testing.assert_allclose(got, np.pi / 9, rtol=1e-3)  # as above


@pytest.mark.parametrize("scale", [0.001, 1.0, 1000.0])
def test_a_sphere_looks_the_same_in_any_unit(scale, device):
    got = irradiance(sources.sphere(np.array([0, 0, 3 * scale]), scale, COLOUR), device)
    np.testing.assert_allclose(got, np.pi * COLOUR / 9, rtol=1e-3)  # as above


@pytest.mark.parametrize("normal", [(0, 0, 1), (0.36, 0.48, 0.8), (-0.3, 0.1, 0.9)])
@pytest.mark.parametrize("edges", [([1.0, 0, 0], [0, 1.0, 0]), ([0, 2.0, 0], [-0.5, 0, 0]), ([0.8, 0, 0.6], [0, 0.4, 0])],
                         ids=["square", "upright", "leaning"])
def test_a_rectangle_lights_as_lambert_says(edges, normal, device):
    """Tolerance: the middles of some 16 × 16 patches, of which the widest is a twentieth of the distance, stand for them: (1/20)² / 24
    times the curvature of cos · cos / d², some 8 times its value in both directions together."""
    u, v = np.array(edges)
    normal = np.array(normal) / np.linalg.norm(normal)
    centre, pixel = np.array([0.2, -0.1, 1.4]), np.array([0.05, 0.1, 0.0])
    corners = np.array([centre + (s * u + t * v) / 2 for s, t in ((-1, -1), (1, -1), (1, 1), (-1, 1))])
    got = irradiance(sources.rectangle(centre, u, v, COLOUR), device, normal=normal, position=pixel)
    np.testing.assert_allclose(got, COLOUR * polygon_irradiance(corners, pixel, normal), rtol=1e-3)


def test_a_rectangle_shines_to_one_side(device):
    """Of u right and v up, away from the viewer, as UsdLux says of an unturned RectLight: along -z."""
    u, v, centre = np.array([1.0, 0, 0]), np.array([0, 1.0, 0]), np.array([0, 0, 2.0])
    given = sources.rectangle(centre, u, v, COLOUR)
    np.testing.assert_allclose(given.axis[:, :3], np.tile([0, 0, -1], (given.count, 1)), atol=1e-7)
    assert (irradiance(given, device) > 0.1).all()
    assert (irradiance(sources.rectangle(centre, v, u, COLOUR), device) == 0).all()


@pytest.mark.parametrize("sides", [(1, 1), (3, 0.2), (0.001, 5)])
def test_a_rectangle_sends_the_flux_of_its_area(sides):
    """Intensity along its normal is L A, whatever the number of samples, which is near to that asked for unless one side is hardly any."""
    given = sources.rectangle(np.zeros(3), np.array([sides[0], 0, 0]), np.array([0, sides[1], 0.0]), COLOUR)
    np.testing.assert_allclose(given.energy.sum(axis=0, dtype=float), COLOUR * sides[0] * sides[1], rtol=1e-5)  # float32
    np.testing.assert_allclose(given.place[:, :3].mean(axis=0, dtype=float), 0, atol=1e-6)
    assert np.abs(given.place[:, 0]).max() < sides[0] / 2 and np.abs(given.place[:, 1]).max() < sides[1] / 2
    if max(sides) < 20 * min(sides):
        assert 0.8 * sources.RECTANGLE_SAMPLES < given.count < 1.2 * sources.RECTANGLE_SAMPLES


@pytest.mark.parametrize("count", [sources.FEW, sources.SPHERE_SAMPLES])
def test_samples_of_a_sphere_lie_on_it_and_have_its_area(count):
    centre = np.array([1.0, 2.0, 3.0])
    given = sources.sphere(centre, 0.5, COLOUR, count)
    assert given.count == count
    out = given.place[:, :3] - centre
    np.testing.assert_allclose(np.linalg.norm(out, axis=1), 0.5, rtol=1e-5)  # float32 places
    np.testing.assert_allclose(out / 0.5, given.axis[:, :3], atol=1e-5)
    np.testing.assert_allclose(given.energy.sum(axis=0, dtype=float), COLOUR * np.pi, rtol=1e-5)  # 4π R² L
    np.testing.assert_allclose(given.axis[:, :3].mean(axis=0), 0, atol=0.01)  # evenly


def test_a_point_without_axis_shines_evenly(device):
    for axis, exponent in ((None, 0.0), (None, 5.0), (np.array([0, 0, 1.0]), 0.0)):
        given = sources.point(np.array([0, 0, 2.0]), COLOUR, axis, exponent)
        np.testing.assert_allclose(irradiance(given, device), COLOUR / 4, rtol=1e-6)  # float32


@pytest.mark.parametrize("exponent", [0.5, 1.0, 3.0])
def test_a_point_with_an_axis_falls_off_by_its_cosine(exponent, device):
    """Above the pixel, leaning by 60 degrees: I cos^μ / d²."""
    given = sources.point(np.array([0, 0, 2.0]), COLOUR, np.array([np.sin(np.pi / 3), 0, -0.5]), exponent)
    np.testing.assert_allclose(irradiance(given, device), COLOUR / 4 * 0.5**exponent, rtol=1e-6)  # float32


def test_a_far_light_is_its_irradiance(device):
    given = sources.far(np.array([[0.6, 0, 0.8], [0, 0, 1]]), np.array([[1, 2, 0.5], [1, 1, 1.0]]))
    np.testing.assert_allclose(irradiance(given, device), 0.8 * COLOUR + 1, rtol=1e-6)  # float32
    assert (given.place[:, 3] == 0).all() and (given.occluder == sources.NEVER).all()


def test_joined_samples_keep_their_order():
    parts = [sources.far(np.eye(3), np.eye(3)), sources.point(np.ones(3), COLOUR), sources.sphere(np.zeros(3), 1.0, COLOUR, 5)]
    whole = sources.join(parts)
    assert whole.count == 9
    for field in range(5):
        np.testing.assert_array_equal(whole[field][3], parts[1][field][0])
        np.testing.assert_array_equal(whole[field][4:], parts[2][field])
        assert whole[field].dtype == parts[0][field].dtype


def test_few_samples_of_a_far_away_sphere_lie_in_its_direction():
    given = sources.sphere(np.array([0, 30.0, 40.0]), 1.0, COLOUR, sources.FEW)
    direction = given.place[:, :3] / np.linalg.norm(given.place[:, :3], axis=1, keepdims=True)
    assert angle_degrees(direction, np.array([[0, 0.6, 0.8]])).max() < np.degrees(np.arcsin(1 / 50)) + 1e-3


@pytest.mark.parametrize("radius", [0.0, -1.0, np.nan])
def test_a_sphere_without_a_radius_is_refused(radius):
    with pytest.raises(ArrayError, match=r"radius of a sphere light is .*: it must be above 0"):
        sources.sphere(np.zeros(3), radius, COLOUR)


@pytest.mark.parametrize("u, v", [([0, 0, 0], [0, 1, 0]), ([1, 0, 0], [0, 0, 0]), ([1, 0, 0], [0.1, 1, 0]), ([1, 0, 0], [1, 0, 0])])
def test_a_rectangle_without_a_right_angle_is_refused(u, v):
    with pytest.raises(ArrayError, match=r"edges of a rectangle light are .*: give two at a right angle"):
        sources.rectangle(np.zeros(3), np.array(u), np.array(v), COLOUR)
