"""Sums of images for near light: against a twin that tries all triangles, against the weighting of far light, and against the model."""

import numpy as np
import pytest

from kernels.errors import ArrayError
from kernels.relight.frames.near_sum import sum_near
from kernels.relight.model import sources
from service.relight.weights.triangulation import triangles_between, triangulate_sphere
from service.relight.weights.weighting import integrate_discs
from service.requests.relight import LightWeights
from tests.kernels.relight.lights import AXES, CUBE, icosahedron, ring, scattered, turn
from tests.kernels.relight.surfaces import FLOAT, LOBE, captured, scattered_pixels
from tests.kernels.scenes import colours
from tests.reference import shading as reference
from tests.reference.sampling import lattice

SHARE = 5e-6
"""Shares come from float32 directions and planes; lights here are 0.1 rad apart or more."""
LIGHTS = lattice(20, 180)
NEAR = {
    "point": sources.point(np.array([0.3, -0.4, 1.2]), np.array([1, 2, 3.0])),
    "behind": sources.point(np.array([-0.3, 0.4, -1.2]), np.array([1, 2, 3.0])),
    "spot": sources.point(np.array([0.5, 0.4, 1.2]), np.array([3, 2, 1.0]), np.array([-0.36, -0.48, -0.8]), 3.0),
    "sphere": sources.sphere(np.array([-0.8, 0.5, 0.6]), 0.3, np.array([1, 2, 3.0]), sources.FEW),
    "rectangle": sources.rectangle(np.array([0.2, -0.6, 1.0]), np.array([0.8, 0, 0]), np.array([0, 0.5, 0]), np.ones(3), sources.FEW),
    "far": sources.far(scattered(30, 3), np.random.default_rng(3).random((30, 3))),
}
ALL = sources.join(list(NEAR.values()))


def summed(pixels, readings, given, lights, device, *, visible=None, irradiance=None):
    """[6, P] of sum_near, and the readings that its band holds."""
    irradiance = 3 * colours(len(lights), seed=4) if irradiance is None else irradiance
    seen, held = captured(pixels, readings, lights, irradiance, device, visible=visible)
    got = sum_near(seen, given, triangles_between(lights))
    return got.numpy()[:, : len(pixels.normal)], held


def images(lights, count, seed=0):
    return np.random.default_rng(seed).uniform(0.1, 1, (len(lights), 3, count))


def scene(count=45, seed=0):
    """Pixels, images and what the pixels see of the lights, all unrelated."""
    visible = np.random.default_rng(seed).choice(np.array([0, 100, 255], np.uint8), (len(LIGHTS), count))
    return scattered_pixels(count, seed), images(LIGHTS, count, seed), visible


@pytest.mark.parametrize("given", [*NEAR.values(), ALL], ids=[*NEAR, "all"])
@pytest.mark.parametrize("count", [1, 45])
def test_it_is_the_twin(given, count, device):
    pixels, readings, visible = scene(count)
    got, held = summed(pixels, readings, given, LIGHTS, device, visible=visible)
    expected, weights = reference.sum_near(held, pixels, given, LIGHTS)
    total = weights.sum(axis=0)  # shares sum to one: all that arrives; each share is off by SHARE of it, and float32 sums by some FLOAT
    each = 3 * SHARE + (given.count + len(LIGHTS)) * FLOAT
    assert (np.abs(got[:3] - expected) <= each * total * held.max(axis=0)).all()
    model = reference.readings(pixels, LIGHTS, visible)
    expected = (weights * model).sum(axis=0)
    assert (np.abs(got[3:] - expected) <= each * total * model.max(axis=0) + LOBE * expected).all()
    assert count == 1 or expected.max() > 0.001


LAYOUTS = {"octahedron": AXES, "icosahedron": icosahedron() @ turn(0).T, "even": LIGHTS, "many": lattice(150, 180), "any": scattered(40, 2),
           "cube": CUBE, "rings": np.concatenate([AXES[[1, 4]], *(ring(12, e) for e in (-60, -30, 0, 30, 60))]), "half": lattice(96, 90),
           "dome": np.concatenate([AXES[[1]], *(ring(12, e) for e in (0, 30, 60))])}


@pytest.mark.parametrize("direction", LAYOUTS.values(), ids=LAYOUTS)
def test_a_light_far_away_is_shared_out_as_smooth_weighting_does(direction, device):
    """As a near light a million away and as a far one; in polygons and, below a dome, in holes too. Tolerance: SHARE, the pixels'
    places, a millionth of the distance, and the thousandth of an imaginary light that goes to others."""
    holes = len(triangulate_sphere(direction).vertex) > len(direction)
    pixels, readings, toward = scattered_pixels(3), images(direction, 3, seed=2), scattered(14, 6)
    shares = integrate_discs(toward, np.zeros(14), direction, weighting=LightWeights.SMOOTH)
    for i, share in enumerate(shares):
        given = (sources.point(1e6 * toward[i], 1e12 * np.array([1, 2, 3])) if i % 2 else
                 sources.far(toward[[i]], np.array([[1, 2, 3.0]])))
        got, held = summed(pixels, readings, given, direction, device)
        expected = np.einsum("l,lcp,c->cp", share, held, [1, 2, 3])
        np.testing.assert_allclose(got[:3], expected, rtol=2e-3 if holes else 2e-5)


def test_one_image_bright_shows_what_of_the_light_it_gets(device):
    """Every pixel sees a near light elsewhere: from under it the light is at the zenith, from beside it is not."""
    pixels = scattered_pixels(2)._replace(position=np.float32([[0, 0, 0], [-2, 0, 0]]))
    readings = np.zeros((6, 3, 2))
    readings[AXES.argmax(axis=0)[2]] = 1  # of the light at +z
    got, _ = summed(pixels, readings, sources.point(np.array([0, 0, 2.0]), np.ones(3)), AXES, device, irradiance=np.ones((6, 3)))
    np.testing.assert_allclose(got[:3, 0], 1 / 4, rtol=2 * SHARE)
    np.testing.assert_allclose(got[:3, 1], 0.5 / 8, rtol=2 * SHARE)  # half way between +x and +z, d² = 8


def test_no_light_is_black(device):
    pixels, readings, _ = scene(40)
    assert (summed(pixels, readings, sources.far(np.zeros((0, 3)), np.zeros((0, 3))), LIGHTS, device)[0] == 0).all()


def test_of_lights_in_one_place_the_first_is_taken(device):
    pixels, readings, _ = scene(40)
    twice, both = np.repeat(LIGHTS, 2, axis=0), np.repeat(readings, 2, axis=0)
    both[1::2] = 100
    irradiance = np.ones((40, 3))
    got, _ = summed(pixels, both, NEAR["sphere"], twice, device, irradiance=irradiance)
    expected, _ = summed(pixels, readings, NEAR["sphere"], LIGHTS, device, irradiance=irradiance[:20])
    np.testing.assert_allclose(got, expected, rtol=64 * FLOAT)  # float32 sums over twice as many


@pytest.mark.parametrize("irradiance, message", [
    (np.where(np.arange(60).reshape(20, 3) == 16, 0, 1.0), "irradiance of light 5 is 0 in channel G"),
    (np.where(np.arange(60).reshape(20, 3) == 2, np.nan, 1.0), "irradiance of light 0"),
])
def test_a_light_without_irradiance_is_refused(irradiance, message, device):
    pixels, readings, _ = scene()
    seen, _ = captured(pixels, readings, LIGHTS, np.ones((20, 3)), device)
    with pytest.raises(ArrayError, match=message):
        sum_near(seen._replace(irradiance=irradiance), NEAR["point"], triangles_between(LIGHTS))
