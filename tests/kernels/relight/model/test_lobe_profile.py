"""Profiles of the specular part: plain for images that are the model, found where they are not, and no gloss for a wrong albedo."""

import numpy as np
import pytest

from kernels.relight.model.lobe_profile import PLAIN, fit_profile, profile_moments
from kernels.relight.model.shading import shade, upload_surface
from kernels.relight.model.sources import far
from tests.kernels.relight.surfaces import LOBE, captured, scattered_pixels
from tests.kernels.scenes import colours
from tests.reference import shading as reference
from tests.reference.sampling import lattice

LIGHTS = lattice(64, 85)
IRRADIANCE = 3 * colours(64, seed=4)
SIDE = 12
"""Pixels along the side of a square of neighbours."""


def square(seed=0):
    """Scattered normals, of one albedo and lobe."""
    pixels = scattered_pixels(SIDE * SIDE, seed)
    count = len(pixels.normal)
    return pixels._replace(albedo=np.full((count, 3), 0.3, np.float32), f0=np.full((count, 3), 0.2, np.float32),
                           roughness=np.full(count, 0.5, np.float32))


def steepness(pixels, direction):
    """[P] t = 1 / (1 + (tan θ_h / α)²)."""
    half = direction + pixels.view.astype(float)
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    cosine = (half * pixels.normal).sum(axis=1)
    return 1 / (1 + (1 / cosine**2 - 1) / pixels.roughness.astype(float) ** 4)


def fitted(pixels, readings, device, *, clipped=None):
    images, _ = captured(pixels, readings, LIGHTS, IRRADIANCE, device, clipped=clipped)
    moments = profile_moments(images)
    return fit_profile(moments.numpy()[:, : len(pixels.normal)], np.arange(SIDE * SIDE), (SIDE, SIDE))


def with_profile(pixels, profile):
    """Readings [lights, 3, P] of the twin with a profile."""
    matt, gloss = reference.parts(pixels, LIGHTS)
    t = np.stack([steepness(pixels, light) for light in LIGHTS])[:, None]
    return matt + gloss * (profile[0] + profile[1] * t**2 + profile[2] * t**8)


def test_images_that_are_the_model_have_the_plain_profile(device):
    """Tolerance: half rounding of the images."""
    pixels = square()
    np.testing.assert_allclose(fitted(pixels, reference.readings(pixels, LIGHTS), device), np.tile(PLAIN, (SIDE**2, 1)), atol=0.01)


@pytest.mark.parametrize("profile", [(1.6, 0, 0), (0.5, 0, 0), (0.8, 0.1, 1.5), (1, 0.6, -0.5)])
def test_profiles_of_the_images_are_found(profile, device):
    """As factors where the lobe is strong, t above a tenth. Tolerance: half rounding; the prior takes less, because nothing is
    noisy."""
    pixels = square()
    got = fitted(pixels, with_profile(pixels, profile), device)
    t = np.linspace(0.1, 1, 10)
    terms = np.stack([np.ones(10), t**2, t**8])
    np.testing.assert_allclose(got @ terms, np.tile(np.array(profile) @ terms, (SIDE**2, 1)), atol=0.03)


def test_a_wrong_albedo_is_no_gloss(device):
    """Off by half, up and down from pixel to pixel: differences within a window, and each pixel has its own. Tolerance: half rounding."""
    pixels = square()
    wrong = pixels._replace(albedo=pixels.albedo * np.random.default_rng(0).uniform(0.5, 1.5, (SIDE**2, 1)).astype(np.float32))
    got = fitted(wrong, reference.readings(pixels, LIGHTS), device)
    np.testing.assert_allclose(got, np.tile(PLAIN, (SIDE**2, 1)), atol=0.02)


def test_clipped_readings_count_where_they_are_brighter_than_the_model(device):
    """Images that are clipped below the model say nothing of it; without the bits, they would dim the lobe."""
    pixels = square()
    model = reference.readings(pixels, LIGHTS)
    level = np.quantile(model, 0.98)
    clipped = (model >= level).any(axis=1)
    readings = np.minimum(model, level)
    kept, dimmed = (fitted(pixels, readings, device, clipped=bits) for bits in (clipped, None))
    top = np.array([1, 1, 1])
    assert np.abs(kept @ top - 1).max() < 0.1 < np.abs(dimmed @ top - 1).max()
    brighter = fitted(pixels, np.minimum(with_profile(pixels, (3, 0, 0)), 2 * level), device, clipped=clipped)
    assert (brighter @ top).mean() > 1.2


def test_a_surface_without_gloss_has_the_plain_profile(device):
    pixels = square()._replace(roughness=np.zeros(SIDE**2, np.float32))
    np.testing.assert_array_equal(fitted(pixels, 1.5 * reference.readings(pixels, LIGHTS), device), np.tile(PLAIN, (SIDE**2, 1)))


def test_where_no_light_tells_it_a_pixel_has_the_profile_of_the_object(device):
    """Pixels that are dark in every image and in the model, in a corner out of reach of the others' windows."""
    pixels = square()
    readings = with_profile(pixels, (1.5, 0, 0))
    rows, cols = np.indices((SIDE, SIDE))
    dark = ((rows > 5) & (cols > 5)).reshape(-1)
    pixels.f0[dark] = 0
    pixels.roughness[dark] = 0
    readings[:, :, dark] = reference.readings(pixels, LIGHTS)[:, :, dark]
    got = fitted(pixels, readings, device)[SIDE * SIDE - 1]
    np.testing.assert_allclose(got, (1.5, 0, 0), atol=0.05)


def test_shading_multiplies_the_specular_part(device):
    """Never below none. Tolerance: the lobes, and t with them."""
    pixels = scattered_pixels(45)
    profile = np.random.default_rng(1).normal(0, 1, (45, 3)).astype(np.float32)
    surface = upload_surface(*pixels, profile=profile, device=device)
    for light in LIGHTS[::9]:
        got = shade(surface, far(light[None], np.ones((1, 3)))).numpy()[:, :45]
        plain = reference.shade(pixels, far(light[None], np.ones((1, 3))))
        t = steepness(pixels, light)
        factor = np.maximum((profile * np.stack([np.ones(45), t**2, t**8], axis=1)).sum(axis=1), 0)
        np.testing.assert_allclose(got[:3], plain[:3], rtol=LOBE, atol=1e-6)
        assert (np.abs(got[3:] - factor * plain[3:]) <= 20 * LOBE * plain[3:] * np.abs(profile).sum(axis=1) + 1e-6).all()
