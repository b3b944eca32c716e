"""Descents against the cost and the slopes of an independent float64 model, and what neighbours and surveys add to them."""

import numpy as np
import pytest
import warp as wp

from kernels.errors import ArrayError
from kernels.microfacet import SHORT_TAILS, diffuse_with_slopes, ggx_with_slopes, masking_root, masking_slope, short_tails
from kernels.photometric.model.samples import host_values
from kernels.photometric.search.descent import COLD, WARM, Schedule, descend
from kernels.photometric.search.hypotheses import LobeShape, Prior, RingOptions, search_normals
from kernels.photometric.search.normal_search import STEPS, find_normals, neighbours, propagate
from kernels.photometric.search.survey import CLOSE, survey
from tests.kernels.photometric.test_svbrdf import COLOUR, LIGHTS, VIEW, degrees, render, sample, tilted
from tests.reference import hypotheses, numerical
from tests.reference import microfacet as twin


def turned(normal: np.ndarray, angle: float, seed: int = 1) -> np.ndarray:
    """Normals, each turned by an angle in degrees about an axis of its own."""
    aside = np.cross(normal, np.random.default_rng(seed).normal(size=normal.shape))
    return np.cos(np.radians(angle)) * normal + np.sin(np.radians(angle)) * twin.unit(aside)


def test_slopes_are_those_of_the_model(device):
    """Derivatives of the lobes against central differences of the float64 twin; tolerance: float32 rounding of 1 - (1 - a²) nh²,
    which counts sixteen times in tails."""
    rng = np.random.default_rng(4)
    nl, nv, nh, hv = rng.uniform(0.05, 1, (4, 400))
    alpha, rough, slope, facets = (rng.uniform(*limits, 400) for limits in ((0.1, 1), (0, 1), (-0.3, 0.2), (0, 0.7)))

    @wp.kernel(enable_backward=False, module="unique")
    def evaluate(nl: wp.array(dtype=float), nv: wp.array(dtype=float), nh: wp.array(dtype=float), hv: wp.array(dtype=float),
                 a: wp.array(dtype=float), r: wp.array(dtype=float), s: wp.array(dtype=float),
                 f: wp.array(dtype=float), out: wp.array2d(dtype=float)):
        i = wp.tid()
        root = masking_root(nv[i], a[i])
        value, by_h, by_l, by_v, by_a2 = ggx_with_slopes(nl[i], nv[i], nh[i], a[i], root, masking_slope(nv[i], a[i], root))
        out[0, i] = value
        out[1, i] = by_h
        out[2, i] = by_l
        out[3, i] = by_v
        out[4, i] = by_a2
        matt, on_l, on_v = diffuse_with_slopes(nl[i], nv[i], hv[i] * hv[i], wp.vec4(r[i], s[i], 0.0, f[i]))
        out[5, i] = matt
        out[6, i] = on_l
        out[7, i] = on_v
        factor, on_tails = short_tails(nh[i], a[i])
        out[8, i] = value * factor
        out[9, i] = by_h * factor + value * on_tails
        behind, on_behind = short_tails(0.0 - nh[i], a[i])
        out[10, i] = behind + on_behind

    out = wp.zeros((11, 400), dtype=float, device=device)
    wp.launch(evaluate, dim=400, inputs=[wp.array(v, dtype=float, device=device) for v in (nl, nv, nh, hv, alpha, rough, slope, facets)],
              outputs=[out], device=device)
    got = out.numpy()

    def gloss(nh, nl, nv, a2, gamma=twin.GGX):
        alpha = np.sqrt(a2)
        masking = 1 / (1 + twin.smith_lambda(nl, alpha) + twin.smith_lambda(nv, alpha))
        return twin.distribution(nh, alpha, gamma) * masking / (4 * nv)

    def short(nh):
        return gloss(nh, nl, nv, alpha**2, SHORT_TAILS)

    def matt(nl, nv):
        grazing = 2 * rough * hv**2 - 0.5
        oren_nayar = 1 + facets * np.maximum(2 * hv**2 - 1 - nl * nv, 0) / np.maximum(nl, nv)
        return nl * (1 + slope * (1 - nl)) * (1 + grazing * (1 - nl) ** 5) * (1 + grazing * (1 - nv) ** 5) * oren_nayar

    for rows, function, at, rounding in ((got[:5], gloss, (nh, nl, nv, alpha**2), 2e-3), (got[5:8], matt, (nl, nv), 2e-3),
                                         (got[8:10], short, (nh,), 3e-2)):
        np.testing.assert_allclose(rows[0], function(*at), rtol=rounding, atol=1e-6)
        for row, expected in zip(rows[1:], numerical.slopes(function, at), strict=True):
            np.testing.assert_allclose(row, expected, rtol=5e-3, atol=5e-3 * np.abs(expected).mean())
    assert np.isfinite(got).all()  # of half vectors behind the surface too


@pytest.mark.parametrize("alpha", [0.12, 0.3])
def test_it_ends_at_the_truth(device, alpha):
    """Glossy paint from 12° off, without noise: the lobes of the mixture are not that of the surface, which leaves some tenths of a
    degree."""
    normal = tilted(300)
    samples, _ = sample(render(normal, alpha=alpha), device)
    found = descend(samples, turned(normal, 12.0), shape=LobeShape())
    error = degrees(found.normal, normal)
    assert np.median(error) < 0.2 and np.percentile(error, 99) < 1.5


def test_its_cost_is_that_of_the_normal_it_returns(device):
    """The float64 twin, which fits the mixture at the returned normal from nothing, costs as much: at most 5 % of them differ by a
    tenth, where the twin's mixture ends elsewhere."""
    rng = np.random.default_rng(7)
    normal = tilted(200)
    radiance = render(normal, alpha=0.25) * rng.lognormal(0, 0.05, (48, 200)) * (rng.random((48, 200)) > 0.1)
    samples, _ = sample(radiance, device)
    found = descend(samples, turned(normal, 5.0), shape=LobeShape())
    view = np.tile(VIEW, (200, 1))
    expected = hypotheses.cost(host_values(samples, samples.grey).astype(np.float64), found.normal.astype(np.float64), LIGHTS, view,
                               rounds=30, sweeps=60)
    assert (np.abs(found.cost / expected - 1) > 0.1).mean() < 0.05


def test_it_costs_no_more_than_rings(device):
    """Noise of 5 %, a tenth of the readings shadowed: descents and a survey cost at most what wide and fine rings of candidates do, on
    average."""
    rng = np.random.default_rng(8)
    normal = tilted(300)
    radiance = render(normal, alpha=0.2) * rng.lognormal(0, 0.05, (48, 300)) * (rng.random((48, 300)) > 0.1)
    samples, _ = sample(radiance, device)
    start = turned(normal, 8.0)
    rings = search_normals(samples, start, shape=LobeShape(), options=RingOptions(), wide=CLOSE.rings,
                           fine=(((2.5, 5.0), 10), ((0.9, 1.8), 8), ((0.4,), 6), ((0.2,), 6)))
    found = find_normals(samples, start, shape=LobeShape()).best
    assert found.cost.mean() < 1.01 * rings.cost.mean()


@pytest.mark.long
def test_the_curvature_is_that_of_the_cost(device):
    """The mean rise of the twin's cost at half a degree, on readings that the model explains: within a quarter in the median, because the
    second derivative of the robust cost is not that of its weighted squares."""
    normal = tilted(60)
    samples, _ = sample(render(normal, alpha=0.25), device)
    found = descend(samples, normal, shape=LobeShape(), schedule=Schedule(softened=6, judged=20, softness=16.0, cooling=0.5))
    readings, view = host_values(samples, samples.grey).astype(np.float64), np.tile(VIEW, (60, 1))
    angle = np.radians(0.5)
    tangent = twin.unit(np.cross(found.normal, [0.3, 0.9, 0.1]))
    other = np.cross(found.normal, tangent)

    def cost(at: np.ndarray) -> np.ndarray:
        return hypotheses.cost(readings, at, LIGHTS, view, rounds=30, sweeps=60)

    middle = cost(found.normal.astype(np.float64))
    rises = [cost(np.cos(angle) * found.normal + np.sin(angle) * (np.cos(a) * tangent + np.sin(a) * other)) - middle
             for a in np.arange(8) * np.pi / 4]
    assert np.median(found.curvature * angle**2 / np.mean(rises, axis=0)) == pytest.approx(1, abs=0.25)


def test_a_prior_draws(device):
    """A strong prior keeps the normal near its own, a weak one hardly moves it."""
    normal = tilted(64)
    samples, _ = sample(render(normal), device)
    aside = turned(normal, 6.0)
    free = descend(samples, normal, shape=LobeShape())
    weak, strong = (descend(samples, normal, shape=LobeShape(), prior=Prior(aside.astype(np.float32), strength))
                    for strength in (1e-3, 1e6))
    assert degrees(weak.normal, free.normal).max() < 0.2
    assert degrees(strong.normal, aside).max() < 0.2


def test_neighbours_are_those_of_the_image():
    """Against a loop over all pairs, on a mask with holes."""
    rng = np.random.default_rng(2)
    width = 11
    pixels = np.flatnonzero(rng.random(9 * width) > 0.3)
    found = neighbours(pixels, width)
    place = {(p // width, p % width): i for i, p in enumerate(pixels)}
    for step, (down, right) in enumerate(STEPS):
        expected = [place.get((p // width + down, p % width + right), -1) for p in pixels]
        np.testing.assert_array_equal(found[step], expected)


def test_a_neighbour_hands_on_its_answer(device):
    """Pixels that ended 40° off take the answer of a neighbour; those that are right keep theirs."""
    normal = np.repeat(tilted(16, 30.0), 16, axis=0)
    samples, _ = sample(render(normal, alpha=0.2), device)
    best = descend(samples, normal, shape=LobeShape())
    wrong = np.arange(256) % 16 < 8
    stuck = descend(samples, turned(normal, 40.0), shape=LobeShape(), weights=best.weights, schedule=Schedule(softened=0, judged=1))
    for whole, part in zip(best, stuck, strict=True):
        whole[wrong] = part[wrong]
    kept = best.normal[~wrong].copy()
    propagate(samples, best, neighbours(np.arange(256), 16), shape=LobeShape())
    error = degrees(best.normal, normal)
    near = np.arange(256) % 16 >= 2  # reached by some step from the right half
    assert np.percentile(error[wrong & near], 90) < 1
    np.testing.assert_array_equal(best.normal[~wrong], kept)


def test_black_pixels_hand_on_nothing(device):
    """Beside black pixels, as of a mask that is too wide, whose mixture of no lobe costs nothing, lit ones keep normals 3° off at most:
    noise of 5 % turns them by up to 1.8°, and makes each cost enough to ask its neighbours."""
    normal = np.repeat(tilted(16, 30.0), 16, axis=0)
    black = np.arange(256) % 16 < 4
    noise = np.random.default_rng(5).lognormal(0, 0.05, (48, 256))
    samples, _ = sample(render(normal, alpha=0.2) * np.where(black, 0, noise), device)
    start = np.where(black[:, None], turned(normal, 60.0), normal)
    found = find_normals(samples, start, shape=LobeShape(), beside=neighbours(np.arange(256), 16)).best
    assert (found.cost[black] == 0).all() and (found.cost[~black] > 0).all()
    assert degrees(found.normal, normal)[~black].max() < 3


def test_a_survey_finds_another_mode(device):
    """A metal from 35° off: descents alone end beside its highlight at some pixels, the survey finds it."""
    normal = tilted(300, 40.0)
    radiance = render(normal, albedo=0.02 * COLOUR, alpha=0.15, f0=0.7)
    samples, _ = sample(radiance, device)
    start = turned(normal, 35.0)
    alone = descend(samples, start, shape=LobeShape())
    error = degrees(alone.normal, normal)
    assert (error > 5).mean() > 0.05  # the task is hard enough
    surveyed = survey(samples, alone, shape=LobeShape())
    assert surveyed is not None and set(np.flatnonzero(error > 5)) <= set(surveyed.pixels)
    assert (degrees(alone.normal, normal) > 5).mean() < 0.2 * (error > 5).mean()


def test_explained_pixels_need_no_survey(device):
    normal = tilted(64)
    samples, _ = sample(render(normal, f0=None), device)
    assert survey(samples, descend(samples, normal, shape=LobeShape()), shape=LobeShape()) is None


def test_what_does_not_fit_is_refused(device):
    samples, _ = sample(render(tilted(8)), device)
    with pytest.raises(ArrayError, match="start is"):
        descend(samples, tilted(7), shape=LobeShape())
    with pytest.raises(ArrayError, match="weights are"):
        descend(samples, tilted(8), shape=LobeShape(), weights=np.ones((8, 5)))
    with pytest.raises(ArrayError, match="softened"):
        descend(samples, tilted(8), shape=LobeShape(), schedule=WARM)
    assert COLD.softened
