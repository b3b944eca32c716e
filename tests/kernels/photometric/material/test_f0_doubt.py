"""Doubt of normals whose F0 is far above the shared one, on surfaces rendered by the independent float64 model."""

import numpy as np

from kernels.photometric.material.material import Material
from kernels.photometric.search.hypotheses import Diffuse
from kernels.photometric.svbrdf import RINGS, doubt_of_f0
from tests.kernels.photometric.test_svbrdf import COLOUR, degrees, render, sample, tilted

COUNT = 40
SHARED = np.array([[0.04, 0.04, 0.04, 0.45], [0.9, 0.7, 0.4, 0.3]], dtype=np.float32)
NORMAL = tilted(COUNT, 40.0)
TURNED = NORMAL + np.array([0.018, 0.009, 0.0])
TURNED /= np.linalg.norm(TURNED, axis=1, keepdims=True)


def material(f0: float, cost: float) -> Material:
    """A material of each pixel, with a cost of its fit."""
    return Material(np.tile(COLOUR, (COUNT, 1)).astype(np.float32), np.full((COUNT, 3), f0, np.float32), np.full(COUNT, 0.5, np.float32),
                    np.full(COUNT, cost, np.float32))


def test_a_tilt_that_passes_for_an_f0_is_doubt(device):
    """With the shared F0 the true normal is found again, a degree away; tolerance: the radius of the last two rings."""
    samples, _ = sample(render(NORMAL, alpha=0.25, f0=0.04), device)
    doubt = doubt_of_f0(samples, TURNED.astype(np.float32), material(0.12, 0.01), SHARED, shape=Diffuse())
    assert degrees(NORMAL, TURNED).min() > 0.8
    np.testing.assert_allclose(doubt, degrees(NORMAL, TURNED), atol=RINGS[-1] + RINGS[-2])


def test_what_a_shared_f0_does_not_explain_is_no_doubt(device):
    """A dielectric that is bright shows it, and one that is not far above the shared F0 is not looked at."""
    samples, _ = sample(render(NORMAL, alpha=0.25, f0=0.15), device)
    np.testing.assert_array_equal(doubt_of_f0(samples, NORMAL, material(0.15, 0.001), SHARED, shape=Diffuse()), 0)
    samples, _ = sample(render(NORMAL, alpha=0.25, f0=0.04), device)
    for f0 in (0.07, 0.5):  # of a dielectric that is not far above, and of a metal
        np.testing.assert_array_equal(doubt_of_f0(samples, TURNED, material(f0, 0.01), SHARED, shape=Diffuse()), 0)
    np.testing.assert_array_equal(doubt_of_f0(samples, TURNED, material(0.12, 0.01), SHARED[1:], shape=Diffuse()), 0)
