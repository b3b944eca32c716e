"""Normals of metals whose lobe is known, from normals and materials that a highlight between the lights led astray."""

import numpy as np

from kernels.photometric.material.material import Material, fit_material
from kernels.photometric.material.metal_search import Metals, metals_of, search_metals
from kernels.photometric.search.hypotheses import LobeShape
from tests.kernels.photometric.material.test_mixtures import GOLD, LIGHTS, metal
from tests.kernels.photometric.test_svbrdf import degrees, render, sample, tilted

LAMBERT = LobeShape()
LOBE = np.array([[*GOLD, 0.3]], dtype=np.float32)
METALS = Metals(LOBE, 0.0)


def off(normal, angle):
    """The normals turned by an angle, each about another axis."""
    axis = np.random.default_rng(4).normal(size=normal.shape)
    across = np.cross(normal, axis)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    turned = np.cos(np.radians(angle)) * normal + np.sin(np.radians(angle)) * across
    return turned / np.linalg.norm(turned, axis=1, keepdims=True)


def test_a_known_lobe_finds_the_normal(device):
    """From 8 degrees off, where the own material of a pixel follows the wrong normal. A pixel whose highlight no light meets
    keeps what it had. Tolerance: the last ring, and lights that see the tail of the lobe alone."""
    normal = tilted(80, 45.0)
    samples, _ = sample(metal(normal, 0.09), device, lights=LIGHTS)
    wrong = off(normal, 8.0).astype(np.float32)
    found = search_metals(samples, wrong, fit_material(samples, wrong, shape=LAMBERT), METALS, shape=LAMBERT)
    error, moved = degrees(found, normal), (found != wrong).any(axis=1)
    assert moved.mean() > 0.7
    assert np.median(error[moved]) < 0.1 and np.percentile(error[moved], 95) < 2.0


def test_what_is_explained_stays(device):
    """To the last bit: right normals, paint, and every pixel of an object without metals."""
    normal = tilted(60, 45.0)
    gold, paint = metal(normal, 0.09), render(normal, alpha=0.25, lights=LIGHTS)
    cases = ((gold, normal, METALS), (paint, off(normal, 1.0), METALS), (gold, off(normal, 8.0), Metals(LOBE[:0], 0.0)))
    for radiance, start, metals in cases:
        samples, _ = sample(radiance, device, lights=LIGHTS)
        start = start.astype(np.float32)
        found = search_metals(samples, start, fit_material(samples, start, shape=LAMBERT), metals, shape=LAMBERT)
        np.testing.assert_array_equal(found, start)


def test_metals_are_those_of_the_shared_materials():
    """In their order, with the cost that a quarter of the metal pixels stay below."""
    count = 100
    costs = np.arange(count, dtype=np.float32)
    specular = np.where(np.arange(count)[:, None] < 50, GOLD, 0.04).astype(np.float32)
    single = Material(np.zeros((count, 3), np.float32), specular, np.full(count, 0.3, np.float32), costs)
    shared = np.array([[0.04, 0.04, 0.04, 0.5], LOBE[0], [0.2, 0.2, 0.2, 0.4], [0.6, 0.6, 0.6, 0.4]], dtype=np.float32)
    metals = metals_of(shared, single)
    np.testing.assert_array_equal(metals.lobes, shared[[1, 3]])
    assert metals.cost == np.percentile(costs[:50], 25)
    assert not len(metals_of(shared[:1], single._replace(specular=0 * specular)).lobes)
