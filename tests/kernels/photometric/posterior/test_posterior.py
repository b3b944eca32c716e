"""How far readings leave a normal open: σ and confidence of pixels that see much, little or nothing of the sources."""

import numpy as np
import pytest

from kernels.photometric.posterior.modes import weigh
from kernels.photometric.posterior.posterior import Posterior
from kernels.photometric.posterior.sampling import SamplingFit, sampling_tables, solve_sampling
from tests.kernels.photometric.sources import CENTRES, VIEW, readings_of, sphere, table_of
from tests.kernels.scenes import angle_degrees
from tests.reference import sampling as twin

NORMALS = sphere(16, 0.95)
WIDE, NARROW, NARROWEST = 6.0, 17.9, 71.0
"""κ of sources whose radiance falls to a half 28°, 16° and 8° from the middle."""


@pytest.fixture(scope="module")
def tables() -> dict:
    """By device and sharpness, each made once."""
    return {}


def solve(radiance: np.ndarray, device: str, tables: dict, sharpness: float, noise: float, dark_noise: float = 0.0) -> SamplingFit:
    if (device, sharpness) not in tables:
        tables[device, sharpness] = sampling_tables(table_of(device, sharpness=sharpness, count=int(2500 * max(1, sharpness / 18))))
    rng = np.random.default_rng(11)
    read = radiance * (1 + noise * rng.normal(size=radiance.shape)) + dark_noise * radiance.max() * rng.normal(size=radiance.shape)
    return solve_sampling(readings_of(read, device, sharpness=sharpness), tables[device, sharpness], np.broadcast_to(VIEW, (len(read), 3)))


def far_out(fit: SamplingFit, error: np.ndarray) -> float:
    return float((error > np.maximum(5 * fit.sigma, 5)).mean())


@pytest.mark.long
@pytest.mark.parametrize("sharpness", [WIDE, NARROW])
def test_a_mirror_is_as_sure_as_its_errors_are_small(device, tables, sharpness):
    fit = solve(twin.mirror(NORMALS, VIEW, CENTRES, sharpness, f0=0.9), device, tables, sharpness, 0.005, 0.001)
    error = angle_degrees(fit.normal, NORMALS)
    assert 0.2 < np.median(error / fit.sigma) < 1.4  # σ has a floor for the steps of the table, which wide sources hardly feel
    assert (error > 5 * fit.sigma).mean() < 0.02 and far_out(fit, error) < 0.01
    assert np.median(fit.sigma) < (0.25 if sharpness == WIDE else 1.0)


@pytest.mark.long
def test_a_mirror_that_sees_one_narrow_source_or_none_is_unsure(device, tables):
    """A mirror pixel reads one source 8 degrees wide at most: noise is all it has for the rest."""
    radiance = twin.mirror(NORMALS, VIEW, CENTRES, NARROWEST, f0=0.9)
    fit = solve(radiance, device, tables, NARROWEST, 0.005, 0.002)
    error = angle_degrees(fit.normal, NORMALS)
    assert np.median(error) > 4  # the readings do not tell more
    assert far_out(fit, error) < 0.01 and 0.4 < np.median(error / fit.sigma) < 1.4
    assert (fit.sigma[error > 5] > 2.3).all()
    blind = radiance.max(axis=1) < 0.005 * radiance.max()  # sees hardly more than the noise
    assert blind.sum() > 5 and (fit.sigma[blind] > 15).mean() > 0.8


@pytest.mark.long
def test_a_metal_between_narrow_sources_stays_right(device, tables):
    fit = solve(twin.ggx(NORMALS, VIEW, CENTRES, NARROWEST, alpha=0.25, f0=0.8), device, tables, NARROWEST, 0.01)
    error = angle_degrees(fit.normal, NORMALS)
    assert np.median(error) < 0.6 and far_out(fit, error) < 0.01
    assert 0.4 < np.median(error / fit.sigma) < 1.8  # the fixed widths of the lobes leave more than their noise


@pytest.mark.long
def test_noise_widens_sigma_with_the_error(device, tables):
    radiance = 0.5 * twin.lambert(NORMALS, CENTRES, WIDE)
    for noise in (0.005, 0.02):
        fit = solve(radiance, device, tables, WIDE, noise)
        ratio = angle_degrees(fit.normal, NORMALS) / fit.sigma
        assert 0.5 < np.median(ratio) < 1.4 and (ratio > 5).mean() < 0.01


def posterior(tilt: float, sigma: float, cost: float) -> Posterior:
    normal = np.array([[np.sin(np.radians(tilt)), 0, np.cos(np.radians(tilt))]], dtype=np.float32)
    one = np.ones(1, dtype=np.float32)
    return Posterior(normal, sigma * one, cost * one, -10 * one, one)


def test_two_modes_that_explain_alike_are_a_toss_up():
    both = weigh(posterior(0, 0.5, 20), posterior(30, 0.5, 20))
    assert both.probability == pytest.approx(0.5) and both.sigma == pytest.approx(0.5)
    assert both.spread == pytest.approx(np.sqrt(0.25 + 0.5 * 900), rel=1e-3)


def test_the_better_of_two_modes_is_taken():
    """A difference in cost of 10, in squares of the noise, is odds of e⁵."""
    for pair in ((posterior(0, 0.5, 30), posterior(30, 0.5, 20)), (posterior(30, 0.5, 20), posterior(0, 0.5, 30))):
        best = weigh(*pair)
        assert angle_degrees(best.normal, posterior(30, 1, 1).normal) < 0.01
        assert best.probability == pytest.approx(1 / (1 + np.exp(-5)), rel=1e-3)


def test_neighbouring_modes_are_one():
    assert weigh(posterior(0, 0.5, 20), posterior(2, 0.5, 20)).probability == 1
