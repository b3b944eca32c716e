"""Joint refinement on surfaces of one GGX lobe, rendered by the independent float64 model: what went in comes back."""

import numpy as np
import pytest
import warp as wp

from kernels.photometric.material.material import fit_tinted
from kernels.photometric.search.hypotheses import LobeShape
from kernels.photometric.search.light_factors import find_light_factors
from kernels.photometric.search.refine import OPEN, refine, tilt_variance
from kernels.photometric.svbrdf import solve_svbrdf
from tests.kernels.photometric.test_svbrdf import LIGHTS, VIEW, degrees, render, sample, tilted
from tests.reference import microfacet as twin

LAMBERT = LobeShape()
GOLD = (0.9, 0.7, 0.3)


def metal(normal: np.ndarray, roughness: float) -> np.ndarray:
    return np.concatenate([render(normal, albedo=[0.0], alpha=roughness**2, f0=f) for f in GOLD])


def disturbed(normal: np.ndarray, by_degrees: float) -> np.ndarray:
    """Every normal tilted by this angle, each towards an azimuth of its own."""
    azimuth = np.linspace(0, 40, len(normal))
    across = np.stack([np.cos(azimuth), np.sin(azimuth), np.zeros(len(normal))], axis=1)
    across -= (across * normal).sum(axis=1, keepdims=True) * normal
    return twin.unit(np.cos(np.radians(by_degrees)) * normal + np.sin(np.radians(by_degrees)) * twin.unit(across))


@pytest.mark.parametrize("roughness", [0.35, 0.5, 0.7])
def test_metals_come_back(device, roughness):
    """From 2° off and a roughness of 0.08 off; tolerance: half rounding of the readings, and derivatives by differences."""
    normal = tilted(61, 40.0)
    found = refine(sample(metal(normal, roughness), device)[0], disturbed(normal, 2.0), np.full(61, roughness + 0.08), shape=LAMBERT)
    assert np.median(degrees(found.normal, normal)) < 0.03
    assert np.percentile(degrees(found.normal, normal), 90) < 0.3
    np.testing.assert_allclose(np.median(found.roughness), roughness, atol=0.003)


@pytest.mark.parametrize(("rough", "slope", "facets"), [(None, 0.0, 0.0), (0.5, -0.1, 0.0), (None, 0.0, 0.44)])
def test_dielectrics_come_back(device, rough, slope, facets):
    """Albedo, F0 and the diffuse shape beside the lobe; tolerance as above, the lobe being faint."""
    normal = tilted(50, 45.0)
    shape = LobeShape(rough=-1.0 if rough is None else rough, slope=slope, facets=facets)
    samples, _ = sample(render(normal, alpha=0.2, f0=0.05, rough=rough, slope=slope, facets=facets), device)
    found = refine(samples, disturbed(normal, 1.0), np.full(50, 0.5), shape=shape)
    assert np.median(degrees(found.normal, normal)) < 0.05
    np.testing.assert_allclose(np.median(found.roughness), np.sqrt(0.2), atol=0.01)


def test_cost_never_rises(device):
    """On readings that no model explains, and on dark and one-light pixels: finite, unit, facing the viewer, no dearer than the start."""
    rng = np.random.default_rng(9)
    normal = tilted(45, 70.0)
    radiance = render(normal) * rng.uniform(0, 2, size=(3, 48, 45))
    radiance[:, :, 3] = 0
    radiance[:, 1:, 7] = 0
    samples, _ = sample(radiance, device)
    start = fit_tinted(samples, normal, shape=LAMBERT)
    found = refine(samples, normal, start.roughness, shape=LAMBERT)
    assert all(np.isfinite(values).all() for values in found)
    np.testing.assert_allclose(np.linalg.norm(found.normal, axis=1), 1, atol=1e-5)
    assert ((found.normal * VIEW).sum(axis=1) > 0).all()
    # the linear fit starts afresh, so a start of many minima may be met a little off: the medians must not rise
    assert np.median(found.cost - start.cost) <= 0


def test_the_single_lobe_takes_over_on_metals_only(device):
    """The whole solver is sharper than its lobes on a metal, and keeps to the mixture where that explains more: two lobes in one pixel."""
    normal = tilted(40, 40.0)
    start = disturbed(normal, 3.0)
    brass = solve_svbrdf(sample(metal(normal, 0.45), device)[0], start, shape=LAMBERT)
    assert np.median(degrees(brass.normal, normal)) < 0.05
    mixed = render(normal, alpha=0.1, f0=0.03) + render(normal, alpha=0.5, f0=0.2) * 0.5
    both = solve_svbrdf(sample(mixed, device)[0], start, shape=LAMBERT)
    alone = refine(sample(mixed, device)[0], start, np.full(40, 0.5), shape=LAMBERT)
    assert np.median(degrees(both.normal, normal)) <= np.median(degrees(alone.normal, normal)) + 0.02


NORMAL = tilted(240, 60.0)
ROW, COL = (np.floor((part + 1) * 4).astype(int) for part in NORMAL.T[:2])
"""Squares of an image of the ball that these normals are."""


def found(radiance, device):
    samples, _ = sample(radiance, device)
    return find_light_factors(samples, twin.unit(NORMAL + [0.02, -0.01, 0]), LIGHTS, ROW, COL, shape=LobeShape())


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
    assert not find_light_factors(samples, NORMAL, LIGHTS, 0 * ROW, 0 * COL, shape=LobeShape()).believed


def test_a_curvature_that_is_not_positive_leaves_the_normal_open(device):
    """Products of float32 may leave two falling directions, whose determinant is positive too: σ was the root of a negative number.

    Tolerance: float32 rounding of a determinant that is as small as a thousandth of the diagonal's product.
    """
    rng = np.random.default_rng(0)
    turns = np.linalg.qr(rng.normal(size=(3000, 3, 3)))[0]
    values = rng.uniform(0.2, 2, (3000, 3)) * np.where(np.arange(3000)[:, None] % 2, 1, rng.choice([-1, 1], (3000, 3)))
    given = ((turns * values[:, None]) @ np.swapaxes(turns, 1, 2)).astype(np.float32)

    @wp.kernel(enable_backward=False, module="unique")
    def evaluate(m: wp.array3d(dtype=float), out: wp.array(dtype=float)):
        i = wp.tid()
        out[i] = tilt_variance(m[i, 0, 0], m[i, 0, 1], m[i, 0, 2], m[i, 1, 1], m[i, 1, 2], m[i, 2, 2])

    out = wp.zeros(3000, dtype=float, device=device)
    wp.launch(evaluate, dim=3000, inputs=[wp.array(given, dtype=float, device=device)], outputs=[out], device=device)
    positive = (values > 0).all(axis=1)
    assert (np.diagonal(given, axis1=1, axis2=2) > 0).all(axis=1)[~positive].sum() > 50
    expected = np.where(positive, np.linalg.inv(given.astype(np.float64))[:, [0, 1], [0, 1]].sum(axis=1), OPEN)
    np.testing.assert_allclose(out.numpy(), expected, rtol=1e-4)
