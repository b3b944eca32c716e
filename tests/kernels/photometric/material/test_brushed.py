"""Streaks of brushed surfaces, rendered by an independent float64 model, of the slopes of its facets."""

import numpy as np
import pytest

from kernels.errors import ArrayError
from kernels.photometric.material.brushed import fit_brushed
from kernels.photometric.search.hypotheses import LobeShape
from tests.kernels.photometric.test_svbrdf import COLOUR, VIEW, degrees, sample, tilted
from tests.reference import microfacet as twin
from tests.scenes.glossy import sphere_directions

COUNT = 120
F0 = np.array([0.9, 0.7, 0.4])
NORMAL = tilted(COUNT, 60.0)
ACROSS = twin.unit(np.cross(NORMAL, [0.3, 1.0, 0.2]))


def brushed(lights, widths, albedo=(0, 0, 0)):
    """[3, lights, n] radiance under unit irradiance."""
    light = lights[:, None]
    return np.stack([rho * twin.diffuse(NORMAL, light, VIEW) + twin.streak(NORMAL, ACROSS, light, VIEW, np.array(widths), f0)
                     for rho, f0 in zip(albedo, F0, strict=True)])


def starts_about(normal, off_degrees, widths=(0.3, 0.12)):
    """[8, n, 8] lobes about normals that are off, with tangents all around."""
    axis = twin.unit(np.cross(normal, [0.0, 0.2, 1.0]))
    off = np.cos(np.radians(off_degrees)) * normal + np.sin(np.radians(off_degrees)) * axis
    other = np.cross(off, twin.unit(np.cross(off, axis)))
    turned = [np.cos(t) * other + np.sin(t) * np.cross(off, other) for t in np.arange(8) * np.pi / 8]
    return np.stack([np.concatenate([off, tangent, np.tile(widths, (len(off), 1))], axis=1) for tangent in turned])


@pytest.mark.parametrize(("widths", "albedo"), [((0.35, 0.1), (0, 0, 0)), ((0.25, 0.12), COLOUR)])
def test_normal_tangent_widths_and_material_of_a_streak(device, widths, albedo):
    """The fit begins from normals 3 degrees off, under 40 lights. Half floats round readings to 2^-11 of each, which leaves normals within
    a thousandth of a radian and the other unknowns within five times as much. A tangent has no sign."""
    lights = sphere_directions(40)
    samples, _ = sample(brushed(lights, widths, albedo), device, lights=lights)
    found = fit_brushed(samples, starts_about(NORMAL, 3.0), shape=LobeShape())
    turned = np.abs((found.tangent * ACROSS).sum(-1))
    assert np.percentile(degrees(found.normal, NORMAL), 80) < np.degrees(1e-3)
    assert np.percentile(turned, 20) > 1 - 5e-3
    np.testing.assert_allclose(np.median(found.widths, axis=0), widths, rtol=5e-3)
    np.testing.assert_allclose(np.median(found.specular, axis=0), F0, rtol=5e-3)
    np.testing.assert_allclose(np.median(found.diffuse_albedo, axis=0), albedo, atol=5e-3)
    np.testing.assert_allclose(np.linalg.norm(found.normal, axis=1), 1, atol=1e-6)


def test_the_error_holds_noise(device):
    """Noise is 5 % of each reading, under 40 lights. Of two Gaussian tilts the angle is 0.83 of σ in the median, which 120 pixels tell
    within a fifth, and 1.5 at the 90th percentile. The second may be twice that, as few bright readings tell σ and some fits stop early."""
    lights = sphere_directions(40)
    radiance = brushed(lights, (0.35, 0.15))
    radiance *= 1 + 0.05 * np.random.default_rng(5).normal(size=radiance.shape[1:])
    samples, _ = sample(radiance, device, lights=lights)
    found = fit_brushed(samples, starts_about(NORMAL, 3.0), shape=LobeShape())
    off = degrees(found.normal, NORMAL) / found.sigma
    assert 0.66 < np.median(off) < 1.0
    assert np.percentile(off, 90) < 3.1


def test_a_round_lobe_explains_round_highlights_and_no_streaks(device):
    """A second width is worth nothing on a round highlight, whose readings are all explained, and nine tenths of the cost on a streak."""
    lights = sphere_directions(40)
    for widths, alike in (((0.2, 0.2), True), ((0.4, 0.1), False)):
        samples, _ = sample(brushed(lights, widths), device, lights=lights)
        streak = fit_brushed(samples, starts_about(NORMAL, 3.0), shape=LobeShape())
        plain = fit_brushed(samples, starts_about(NORMAL, 3.0, (0.2, 0.2)), shape=LobeShape(), round_lobe=True)
        np.testing.assert_array_equal(plain.widths[:, 0], plain.widths[:, 1])
        if alike:
            assert np.percentile(plain.cost, 90) < 1e-4
        else:
            assert np.percentile(streak.cost / plain.cost, 80) < 0.1


def test_starts_are_checked(device):
    """Starts for another number of pixels, and none, are refused."""
    lights = sphere_directions(16)
    samples, _ = sample(brushed(lights, (0.3, 0.1)), device, lights=lights)
    for starts in (np.zeros((0, 1, 8)), np.zeros((2, COUNT - 1, 8)), np.zeros((2, COUNT, 7))):
        with pytest.raises(ArrayError, match=r"starts are \("):
            fit_brushed(samples, starts, shape=LobeShape())
