"""Two materials in a pixel, on readings that the independent float64 model mixes."""

import numpy as np

from kernels.photometric.material.material import fit_material
from kernels.photometric.material.mixtures import LEAST_SHARE, NO_PAIRS, choose_pairs, mix_materials, single_lobe
from kernels.photometric.material.shared_materials import choose_materials
from kernels.photometric.search.hypotheses import LobeShape
from tests.kernels.photometric.test_svbrdf import COLOUR, render, sample, tilted
from tests.marks import first_short
from tests.reference.sampling import lattice

LAMBERT = LobeShape()
GOLD = (0.95, 0.68, 0.35)
PAINT = 0.04
LIGHTS = lattice(96, 80.0)
PIXELS = 120


def metal(normal, alpha, lights=LIGHTS):
    return np.concatenate([render(normal, albedo=[0.0], alpha=alpha, f0=f, lights=lights) for f in GOLD])


def border(share, *, metal_rough=0.3, paint_rough=0.5, noise=0.0):
    """[3, light, pixel] radiance of pixels of which `share` is gold and the rest paint; and their normals."""
    normal = tilted(len(share), 45.0)
    paint = render(normal, alpha=paint_rough**2, f0=PAINT, lights=LIGHTS)
    radiance = share * metal(normal, metal_rough**2) + (1 - share) * paint
    return radiance * (1 + noise * np.random.default_rng(7).normal(size=radiance.shape)), normal


def shares():
    """Half of the pixels mixed, a quarter gold and a quarter paint, in no order over the normals."""
    share = np.repeat([0.0, 1.0, 0.5, 0.5], PIXELS // 4)
    share[PIXELS // 2 :] = np.linspace(0.1, 0.9, PIXELS // 2)
    return np.random.default_rng(3).permutation(share)


def solve(radiance, normal, device):
    samples, _ = sample(radiance, device, lights=LIGHTS)
    shared = choose_materials(samples, normal, shape=LAMBERT)
    single = fit_material(samples, normal, shape=LAMBERT, shared=shared)
    pairs = choose_pairs(samples, normal, shared, single, shape=LAMBERT)
    return single, pairs, *mix_materials(samples, normal, single, pairs, shape=LAMBERT)


@first_short(("metal_rough", "noise"), [(0.3, 0.0), (0.5, 0.0), (0.3, 0.02)])
def test_gold_on_paint(device, metal_rough, noise):
    """The share of gold is found where both materials are seen; one lobe misses that of most of these pixels by far. Tolerances: the shared
    gold is within a twentieth of F0 0.95; noise of 2 % hides lobes that reach few lights."""
    share = shares()
    single, pairs, material, mixture = solve(*border(share, metal_rough=metal_rough, noise=noise), device)
    assert len(pairs) >= 1
    gold = np.array([pair[:, 0].argmax() for pair in pairs])[mixture.pair]
    found = np.where(gold == 0, mixture.abundance, 1 - mixture.abundance)
    strength = found * pairs[mixture.pair, gold, 0] / GOLD[0]
    mixed, middle = mixture.abundance > 0, (share > 0.15) & (share < 0.6)
    assert mixed[middle].mean() > 0.9
    assert np.percentile(np.abs(strength - share)[mixed & middle], 90) < 0.06
    np.testing.assert_allclose(np.median(pairs[mixture.pair, gold, 3][mixed]), metal_rough, atol=0.04)
    albedo = np.abs(material.diffuse_albedo / (COLOUR * np.maximum(1 - share, 0.01)[:, None]) - 1).mean(axis=1)
    assert np.median(albedo[mixed & middle]) < 0.05
    assert np.median(material.cost[mixed]) < 0.5 * np.median(single.cost[mixed])


def test_pure_pixels_among_them_are_not_split(device):
    share = shares()
    single, pairs, material, mixture = solve(*border(share), device)
    pure = (share == 0) | (share == 1)
    assert len(pairs) and (mixture.abundance[pure] == 0).all()
    for before, after in zip(single, material, strict=True):
        np.testing.assert_array_equal(before[pure], after[pure])


@first_short("noise", [0.0, 0.03])
@first_short("share", [0.0, 1.0])
def test_an_object_of_one_material_has_no_pairs(device, share, noise):
    """Nothing is split where no pixel needs two materials, so that nothing is paid either."""
    single, pairs, material, mixture = solve(*border(np.full(PIXELS, share), noise=noise), device)
    assert pairs.shape == NO_PAIRS.shape and material is single and not mixture.abundance.any()


def test_readings_that_no_material_explains_are_not_split(device):
    """Two materials explain noise hardly better than one."""
    normal = tilted(50)
    noise = np.random.default_rng(2).uniform(0.5, 1.5, size=(3, len(LIGHTS), 50))
    _, _, _, mixture = solve(render(normal, lights=LIGHTS) * noise, normal, device)
    assert (mixture.abundance > 0).mean() < 0.1


def test_shares_lie_between_their_bounds(device):
    share = shares()
    _, _, _, mixture = solve(*border(share, noise=0.05), device)
    mixed = mixture.abundance[mixture.abundance > 0]
    assert len(mixed) and (mixed >= LEAST_SHARE).all() and (mixed <= 1 - LEAST_SHARE).all()


def test_the_single_lobe_of_a_mixture():
    """As bright as both at normal incidence, of the width of the one that reflects, and that of both where they are alike."""
    gold, paint = [*GOLD, 0.3], [PAINT] * 3 + [0.5]
    specular, roughness = single_lobe(np.array([0.5, 0.5, 1.0]), np.array([[gold, paint], [paint, [PAINT] * 3 + [0.7]], [gold, paint]]))
    np.testing.assert_allclose(specular, [[0.495, 0.36, 0.195], [PAINT] * 3, GOLD], rtol=1e-6)
    np.testing.assert_allclose(roughness, [0.325, ((0.5**4 + 0.7**4) / 2) ** 0.25, 0.3], atol=0.006)
