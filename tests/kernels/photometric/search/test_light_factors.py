"""Intensities refined from the object: wrong ones are found, and right ones stay, also where the lobes cannot explain the object."""

import numpy as np
import pytest

from kernels.photometric.search.hypotheses import Diffuse
from kernels.photometric.search.light_factors import find_light_factors
from tests.kernels.photometric.test_svbrdf import LIGHTS, render, sample, tilted
from tests.reference import microfacet as twin

NORMAL = tilted(240, 60.0)
ROW, COL = (np.floor((part + 1) * 4).astype(int) for part in NORMAL.T[:2])
"""Squares of an image of the ball that these normals are."""


def found(radiance, device):
    samples, _ = sample(radiance, device)
    return find_light_factors(samples, twin.unit(NORMAL + [0.02, -0.01, 0]), LIGHTS, ROW, COL, shape=Diffuse())


def jitter(size: float) -> np.ndarray:
    return np.exp(np.random.default_rng(4).normal(0, size, len(LIGHTS)))


@pytest.mark.parametrize(("size", "gloss"), [(0.03, None), (0.1, 0.05)])
def test_wrong_intensities_are_found(device, size, gloss):
    """But for a common factor and one that falls with the angle to the viewer, which are albedo and the shape of the diffuse lobe."""
    factor = jitter(size)
    told = found(render(NORMAL, f0=gloss) * factor[:, None], device)
    assert told.believed
    untold = np.stack([np.ones(len(LIGHTS)), LIGHTS[:, 2]], axis=1)
    missed = np.log(told.factor / factor)
    missed -= untold @ np.linalg.lstsq(untold, missed, rcond=None)[0]
    assert missed.std() < 0.15 * size  # what twelve rounds leave: normals have followed the wrong intensities
    assert np.median(told.factor) == pytest.approx(1, abs=0.3 * size)  # albedo keeps its scale


@pytest.mark.parametrize("surface", ["matt", "gloss", "metal", "another fall-off", "noise"])
def test_right_intensities_stay(device, surface):
    """A fall-off that the lobes do not have misses all pixels alike under one light, but other pixels are not explained by it."""
    radiance = render(NORMAL, f0=0.05 if surface == "gloss" else None)
    if surface == "metal":
        radiance = render(NORMAL, albedo=np.zeros(3), alpha=0.25, f0=0.8)
    if surface == "another fall-off":
        radiance = radiance * np.maximum(LIGHTS @ NORMAL.T, 1e-9) ** 0.3
    if surface == "noise":
        radiance = radiance * (1 + 0.03 * np.random.default_rng(1).normal(size=radiance.shape))
    told = found(radiance, device)
    assert not told.believed
    assert (told.factor == 1).all()


def test_half_an_object_cannot_be_left_out(device):
    """All pixels lie in one square, so that none are left to ask."""
    samples, _ = sample(render(NORMAL, f0=None) * jitter(0.1)[:, None], device)
    assert not find_light_factors(samples, NORMAL, LIGHTS, 0 * ROW, 0 * COL, shape=Diffuse()).believed
