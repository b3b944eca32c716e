"""Right manifests are not accused by what a part of the object alone shows."""

import numpy as np
import pytest

from service.light_estimation.explanations import Sample, better_explanation, fit_manifest
from stage.transforms import fibonacci_sphere
from tests.reference.microfacet import specular, unit

VIEW = np.array([0.0, 0.0, 1.0])


@pytest.mark.parametrize("ball", [60, 100])
@pytest.mark.parametrize("alpha", [0.16, 0.3])
def test_a_ball_before_a_metal_plane_tells_that_lights_are_right(ball, alpha):
    """Of a metal plane, light by light, any brightness and any directions of the lights explain the images: the ball refutes them, however
    the normals of a Lambertian fit of the plane scatter."""
    draw = np.random.default_rng(3)
    lights = fibonacci_sphere(60)
    lights = lights[lights[:, 2] > 0.4][:16]
    plane = unit(np.array([0.15, -0.1, 1.0]) + 0.01 * draw.normal(size=(600 - ball, 3)))
    curved = unit(draw.normal(size=(4 * ball, 3)) * [1, 1, 0] + [0, 0, 1])[:ball]
    metal = np.stack([specular(plane, light, VIEW, alpha, 0.9) for light in lights])
    matt = 0.5 / np.pi * np.maximum(lights @ curved.T, 0)
    readings = np.concatenate([metal, matt], axis=1)
    readings *= 1 + 0.01 * draw.normal(size=readings.shape)
    radiance = np.repeat(readings[..., None], 3, axis=2)
    sample = Sample(radiance, readings > 0, lights, np.ones((16, 3)), np.ones(16), "lin_rec709_scene")
    assert better_explanation(sample, fit_manifest(sample)) is None
