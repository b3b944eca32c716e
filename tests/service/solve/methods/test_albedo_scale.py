"""The scale of albedo, from shadows that only bounced light reaches, against radiosity in float64."""

import numpy as np
import pytest

from service.solve.methods.settling import fit_albedo_scale
from tests.kernels.scenes import cap
from tests.reference.groove import Groove


def shadows(groove: Groove, *, albedo: float, scale: float, stray: float = 0.0, noise: float = 0.0):
    """What fit_albedo_scale takes, under lights that are declared `scale` times too bright, with the true form factors."""
    lights = cap(48, 75.0)
    whole, _ = groove.radiance(lights, albedo)
    rng = np.random.default_rng(3)
    seen = (whole + albedo * stray) / scale + noise * rng.normal(size=whole.shape) / np.pi
    relative = albedo / scale
    group = (groove.points[:, 0] // 4 * 100 + groove.points[:, 1] // 4).astype(int)
    return seen.T / relative, groove.factors() @ seen.T, groove.normals @ lights.T, group


@pytest.mark.parametrize(("albedo", "scale"), [(0.3, 0.5), (0.6, 2.0), (0.9, 5.0)])
def test_the_scale_is_found(albedo, scale):
    """Form factors are true here, so that the error is that of the noise alone, 1 % of the direct light."""
    fit = fit_albedo_scale(*shadows(Groove(16), albedo=albedo, scale=scale, noise=0.003))
    assert fit is not None
    assert fit.scale == pytest.approx(scale, rel=0.04)
    assert abs(fit.scale - scale) < fit.sigma < 0.15 * scale


def test_stray_light_is_no_bounced_light():
    """Stray light of 1 % of the direct light, which as bounced light would make the scale a fifth larger."""
    fit = fit_albedo_scale(*shadows(Groove(16), albedo=0.5, scale=1.5, stray=0.003))
    assert fit is not None
    assert fit.scale == pytest.approx(1.5, rel=0.04)
    assert fit.stray == pytest.approx(0.003, rel=0.3)


def test_light_of_the_lamps_is_no_bounced_light():
    """A tenth of the readings that should be in shadow are lit, because the normals or the heights are wrong there."""
    ratio, arriving, cosine, group = shadows(Groove(16), albedo=0.5, scale=1.5)
    wrong = (cosine < -0.1) & (np.random.default_rng(1).random(cosine.shape) < 0.1)
    fit = fit_albedo_scale(np.where(wrong, 0.2, ratio), arriving, cosine, group)
    assert fit is not None
    assert abs(fit.scale - 1.5) < 2 * fit.sigma


def test_without_bounced_light_nothing_is_decided():
    """A surface that sees nothing of itself: its shadows hold stray light and noise."""
    ratio, arriving, cosine, group = shadows(Groove(16), albedo=0.5, scale=1.0)
    rng = np.random.default_rng(2)
    dark = np.where(cosine < 0.1, 0.004 + 0.002 * rng.random(ratio.shape), ratio)
    assert fit_albedo_scale(dark, np.zeros_like(arriving), cosine, group) is None
    assert fit_albedo_scale(dark, 1e-5 * rng.random(ratio.shape), cosine, group) is None


def test_one_light_or_one_place_decides_nothing():
    ratio, arriving, cosine, group = shadows(Groove(16), albedo=0.5, scale=1.5)
    assert fit_albedo_scale(ratio, arriving, cosine, np.zeros_like(group)) is None
    few = np.arange(48) < 3
    assert fit_albedo_scale(np.where(few, ratio, np.nan), arriving, cosine, group) is None
    assert fit_albedo_scale(np.full_like(ratio, np.nan), arriving, cosine, group) is None
