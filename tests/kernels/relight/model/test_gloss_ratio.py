"""The model under the captured lights with its gloss as bright as the images: against a twin, and frames under a captured light are it."""

import numpy as np
import pytest

from kernels.errors import ArrayError
from kernels.relight.model.gloss_ratio import MOST_RATIO, sum_shown
from tests.kernels.relight.surfaces import LOBE, captured, scattered_pixels
from tests.kernels.scenes import colours
from tests.reference import shading as reference
from tests.reference.sampling import lattice

LIGHTS = lattice(24, 180)
IRRADIANCE = 3 * colours(24, seed=4)


def shown(pixels, readings, energy, device, visible=None):
    images, held = captured(pixels, readings, LIGHTS, IRRADIANCE, device, visible=visible)
    return sum_shown(images, np.asarray(energy)), held


@pytest.mark.parametrize("count", [1, 45, 64])
def test_it_is_the_twin(count, device):
    """The energies have both signs, some are none, and the images differ from the model. Tolerance: twice the lobes, of the sum of what
    is summed; at most MOST_RATIO of it is gloss."""
    rng = np.random.default_rng(count)
    pixels = scattered_pixels(count, seed=count)
    visible = rng.choice(np.array([0, 255, 90], np.uint8), (len(LIGHTS), count))
    energy = rng.normal(0.4, 1, (len(LIGHTS), 3)) * (rng.random(len(LIGHTS)) < 0.8)[:, None]
    model = reference.parts(pixels, LIGHTS, visible)
    got, held = shown(pixels, rng.uniform(0.2, 3, model[0].shape) * model.sum(axis=0), energy, device, visible)
    scaled = model[0] + reference.shown(held, model, MOST_RATIO) * model[1]
    allowed = 4 * LOBE * MOST_RATIO * np.einsum("lc,lcp->cp", np.abs(energy), model.sum(axis=0)) + 1e-6
    assert (np.abs(got.whole - np.einsum("lc,lcp->cp", energy, scaled)) <= allowed).all()
    for c in range(3):
        expected = reference.mean_shown(held[:, c : c + 1], model[:, :, c : c + 1], energy[:, c])[0]
        np.testing.assert_allclose(got.ratio[c], expected, rtol=10 * LOBE)


def test_a_frame_under_a_captured_light_is_its_image(device):
    """What the model says is missing is nothing, however far the image is from the model."""
    pixels = scattered_pixels(45)
    model = reference.parts(pixels, LIGHTS)
    light = int(np.argmax(LIGHTS[:, 2]))
    energy = np.where(np.arange(len(LIGHTS))[:, None] == light, 2.0, 0.0) * np.ones(3)
    got, _ = shown(pixels, 0.05 + np.random.default_rng(0).uniform(0.3, 9, model[0].shape) * model.sum(axis=0), energy, device)
    missing = 2 * (model[0, light] + got.ratio * model[1, light]) - got.whole
    assert np.abs(missing).max() <= 4 * LOBE * MOST_RATIO * 2 * model[:, light].sum(axis=0).max()
    assert np.ptp(got.ratio) > 0.5


@pytest.mark.parametrize("brighter, ratio", [(0.5, 0.5), (1.2, 1.2), (2, MOST_RATIO)])
def test_highlights_that_differ_are_a_ratio_up_to_the_largest(brighter, ratio, device):
    pixels = scattered_pixels(45)
    pixels = pixels._replace(albedo=np.zeros_like(pixels.albedo))
    got, _ = shown(pixels, brighter * reference.readings(pixels, LIGHTS), np.ones((24, 3)), device)
    np.testing.assert_allclose(got.ratio, ratio, rtol=3e-3)  # half rounding of the images, and of small ones below its normal range


def test_without_energy_or_gloss_the_ratio_is_one(device):
    pixels = scattered_pixels(40)
    nothing, _ = shown(pixels, np.full((24, 3, 40), 0.5), np.zeros((24, 3)), device)
    assert (nothing.whole == 0).all() and (nothing.ratio == 1).all()
    matte, _ = shown(pixels._replace(roughness=np.zeros(40, np.float32)), np.full((24, 3, 40), 0.5), np.ones((24, 3)), device)
    assert (matte.ratio == 1).all()


def test_energy_of_other_lights_is_refused(device):
    with pytest.raises(ArrayError, match=r"energy is \(20, 3\): give \(24, 3\)"):
        shown(scattered_pixels(40), np.ones((24, 3, 40)), np.ones((20, 3)), device)
