"""How far the albedo of a fitted material may be off, on readings of the independent float64 model."""

import numpy as np
import pytest

from kernels.photometric.material.albedo_error import albedo_error
from kernels.photometric.material.material import Material, fit_given
from kernels.photometric.search.hypotheses import LobeShape
from tests.kernels.photometric.test_svbrdf import render, sample, tilted
from tests.reference.sampling import lattice

LAMBERT = LobeShape()
PAINT = np.array([0.04, 0.04, 0.04, 0.5], np.float32)
LIGHTS = lattice(64, 80.0)
PIXELS = 96


def fitted(device, noise, material=PAINT, turn=0.0):
    """Samples of paint, their normals, turned by some radians, and the albedo of a given lobe."""
    normal = tilted(PIXELS, 40.0)
    radiance = render(normal, alpha=PAINT[3] ** 2, f0=PAINT[0], lights=LIGHTS)
    samples, _ = sample(radiance * (1 + noise * np.random.default_rng(5).normal(size=radiance.shape)), device, lights=LIGHTS)
    turned = normal + turn * np.array([1.0, 0.0, 0.0])
    turned = (turned / np.linalg.norm(turned, axis=1, keepdims=True)).astype(np.float32)
    return samples, turned, fit_given(samples, turned, material, shape=LAMBERT)


def test_noise_of_a_camera(device):
    """Half a percent of noise on paint whose lobe is known: the RMS of error over σ is below 1, because F0 may be a tenth off."""
    samples, normal, found = fitted(device, 0.005)
    error = found.diffuse_albedo - fitted(device, 0.0)[2].diffuse_albedo
    own = albedo_error(samples, normal, found, shape=LAMBERT, shared=PAINT[None]).own
    assert 0.4 < np.sqrt(np.mean((error / own) ** 2)) < 1.1


def test_an_f0_that_no_other_pixel_shares_makes_the_albedo_unsure(device):
    """The readings tell F0 in part, so that σ grows; it is largest where nothing is known of the object's F0, or where that is another."""
    samples, normal, found = fitted(device, 0.005)
    other = PAINT + np.array([0.02, 0.02, 0.02, 0], np.float32)
    known, apart, unknown = (albedo_error(samples, normal, found, shape=LAMBERT, shared=shared).own
                             for shared in (PAINT[None], other[None], None))
    assert (apart > known).all() and (unknown > known).all()
    np.testing.assert_array_equal(albedo_error(samples, normal, found, shape=LAMBERT, shared=np.stack([other, PAINT])).own, known)


def test_albedo_follows_a_tilted_normal_by_the_slope_that_is_told(device):
    """Along one tangent the albedo changes by no more than the steepest slope, on some pixels by nearly that. Tolerance: the second order
    of half a degree, and weights that follow the misfit."""
    degrees = 0.5
    still, moved = fitted(device, 0.0), fitted(device, 0.0, turn=np.radians(degrees))
    steep = np.sqrt(2) * degrees * albedo_error(*still, shape=LAMBERT, shared=PAINT[None]).tilt
    change = np.abs(moved[2].diffuse_albedo - still[2].diffuse_albedo)
    assert (change <= 1.1 * steep + 2e-4).all()
    assert (change / steep).max() > 0.8


def test_a_metal_without_a_diffuse_lobe_has_a_deviation_too(device):
    """The gold's F0 is hardly bounded, but all its readings show it: albedo 0 is known to a percent of what a white surface has."""
    gold = np.array([0.95, 0.68, 0.35, 0.4], np.float32)
    normal = tilted(PIXELS, 40.0)
    radiance = np.concatenate([render(normal, albedo=[0.0], alpha=gold[3] ** 2, f0=f, lights=LIGHTS) for f in gold[:3]])
    samples, _ = sample(radiance * (1 + 0.005 * np.random.default_rng(5).normal(size=radiance.shape)), device, lights=LIGHTS)
    material = Material(np.zeros((PIXELS, 3), np.float32), np.tile(gold[:3], (PIXELS, 1)), np.full(PIXELS, gold[3]), np.zeros(PIXELS))
    own = albedo_error(samples, normal.astype(np.float32), material, shape=LAMBERT, shared=gold[None]).own
    assert (own > 0).all() and np.median(own) == pytest.approx(0.004, abs=0.0035)
