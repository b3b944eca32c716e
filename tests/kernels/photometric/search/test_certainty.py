"""How sure the general solver is where lights are few or say little: no quiet wrong answer."""

import numpy as np
import pytest

from kernels.photometric.model.candidates import rings
from kernels.photometric.search.certainty import ring_areas
from kernels.photometric.search.descent import descend
from kernels.photometric.search.hypotheses import LobeShape
from kernels.photometric.search.lobe_shape import ShapeSpread
from kernels.photometric.search.shared_misfit import UNKNOWN_SHARE, shared_misfit
from kernels.photometric.search.survey import CLOSE
from kernels.photometric.svbrdf import solve_svbrdf
from tests.kernels.photometric.test_svbrdf import COLOUR, degrees, render, sample, tilted
from tests.reference import microfacet as twin
from tests.reference.sampling import lattice

NOISE = 0.01


def noisy(radiance: np.ndarray) -> np.ndarray:
    rng = np.random.default_rng(11)
    return np.maximum(radiance * (1 + NOISE * rng.normal(size=radiance.shape)), 0)


def test_areas_of_the_rings_fill_a_cap():
    """Together the candidates stand for the cap out to half a ring beyond the last one."""
    areas = ring_areas(rings(*CLOSE.rings))
    angles = CLOSE.rings[0]
    edge = angles[-1] + (angles[-1] - angles[-2]) / 2
    assert (areas > 0).all()
    assert areas.sum() == pytest.approx(2 * np.pi * (1 - np.cos(np.radians(edge))) * np.degrees(1) ** 2, rel=1e-3)


@pytest.mark.parametrize("count", [14, 10])
def test_a_metal_under_few_lights_is_not_quietly_wrong(device, count):
    """A pixel sees its highlight under three or four lights; the search starts 30° off, as it may after a Lambertian start on a metal.

    A hundredth of the pixels may be off by more than five standard deviations and five degrees, as of every method.
    """
    lights = lattice(count, 75.0)
    normal = tilted(300, 60.0)
    radiance = noisy(render(normal, albedo=np.zeros(3), alpha=0.2, f0=0.8, lights=lights))
    fit = solve_svbrdf(sample(radiance, device, lights=lights)[0], twin.unit(normal + [0.4, -0.4, 0]), shape=LobeShape())
    error = degrees(fit.normal, normal)
    assert (error > 10).mean() > 0.01  # the task is hard enough to be wrong at
    assert ((error > 10) & (fit.sigma < 1)).mean() < 0.005
    assert ((error > 5 * fit.sigma) & (error > 5)).mean() <= 0.01


def test_three_lights_are_never_sure(device):
    """A gloss under three lights: fewer readings than unknowns, whatever normal and lobes they fit."""
    lights = twin.unit(np.array([[0.6, 0.0, 0.8], [-0.4, 0.5, 0.8], [-0.3, -0.6, 0.75]]))
    normal = tilted(200, 35.0)
    radiance = noisy(render(normal, albedo=0.5 * COLOUR, alpha=0.2, f0=0.06, lights=lights))
    fit = solve_svbrdf(sample(radiance, device, lights=lights)[0], twin.unit(normal + [0.1, 0.05, 0]), shape=LobeShape())
    assert np.percentile(fit.sigma, 5) > 2.3


def test_many_lights_are_as_sure_as_they_are_right(device):
    """In the model: the median error over sigma is about one, and sigma is small. Noise of each pixel is shared with none."""
    normal = tilted(200, 60.0)
    rng = np.random.default_rng(3)
    radiance = render(normal, alpha=0.2)
    radiance = np.maximum(radiance * (1 + 0.03 * rng.normal(size=radiance.shape)), 0)
    fit = solve_svbrdf(sample(radiance, device)[0], twin.unit(normal + [0.03, 0, 0]), shape=LobeShape(), shared_misfit=0.0)
    error = degrees(fit.normal, normal)
    assert 0.4 < np.median(error / fit.sigma) < 1.4
    assert (error > 5 * fit.sigma).mean() < 0.01
    assert np.median(fit.sigma) < 1


def test_a_shape_off_by_its_spread_is_held(device):
    """A rough lobe that is taken for a smoother one, off by its spread: so are normals, about. Without it they are off by five standard
    deviations in the median, and neighbours do not contradict them."""
    normal = tilted(200, 60.0)
    samples, _ = sample(render(normal, rough=0.8, alpha=0.3), device)
    start = twin.unit(normal + [0.03, 0, 0])
    held, sure = (solve_svbrdf(samples, start, shape=LobeShape(rough=0.4), shared_misfit=shared, shape_spread=ShapeSpread(spread, 0.0, 0.0))
                  for shared, spread in ((0.3, 0.4), (0.0, 0.0)))
    error = degrees(held.normal, normal)
    assert np.median(error / sure.sigma) > 3
    assert 0.4 < np.median(error / held.sigma) < 1.1


def test_neighbours_share_misfit_and_no_noise(device):
    """Two pixels of one normal and material. Errors of 5 % that both have are misfit, whatever causes them, and those of each are noise; of
    both kinds alike, half is shared. The tolerance is that of a median over 300 pairs, and of what the fits take up."""
    normal = tilted(300, 50.0)
    clean, rng = render(normal), np.random.default_rng(5)

    def share(common: float, own: float) -> float:
        both = common * rng.normal(size=clean.shape)
        pairs = np.concatenate([clean * (1 + both + own * rng.normal(size=clean.shape)) for _ in range(2)], axis=2)
        samples = sample(pairs, device)[0]
        return shared_misfit(samples, descend(samples, np.tile(normal, (2, 1)), shape=LobeShape()), shape=LobeShape())

    assert share(0.0, 0.05) < 0.1
    assert share(0.05, 0.0) > 0.9
    assert 0.3 < share(0.035, 0.035) < 0.7  # 5 % together, so that both pixels count as explained
    none = sample(clean[..., :1], device)[0]
    assert shared_misfit(none, descend(none, normal[:1], shape=LobeShape()), shape=LobeShape()) == UNKNOWN_SHARE
