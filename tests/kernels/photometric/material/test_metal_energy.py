"""Metals whose pixels blur their lobe have the energy that their readings add up to, and the others stay as they are."""

import numpy as np
import pytest

from kernels.photometric.material.material import fit_material
from kernels.photometric.material.metal_energy import LEAST_PIXELS, with_whole_energy
from kernels.photometric.search.hypotheses import LobeShape
from tests.kernels.photometric.material.test_mixtures import GOLD, metal
from tests.kernels.photometric.test_svbrdf import sample, tilted
from tests.scenes.glossy import sphere_directions

LAMBERT = LobeShape()
ROUGHNESS = 0.28
PAINT = [0.04, 0.04, 0.04, 0.4]


def blurred(normal, lights, degrees):
    """Radiance of a polished metal whose normal turns by so many degrees from side to side of each pixel: the mean of 9 × 9 places."""
    across = np.cross(normal, [0.0, 1.0, 0.0])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    other, places = np.cross(normal, across), np.radians(degrees) * ((np.arange(9) + 0.5) / 9 - 0.5)
    turned = [normal + a * across + b * other for a in places for b in places]
    return np.mean([metal(each / np.linalg.norm(each, axis=1, keepdims=True), ROUGHNESS**2, lights) for each in turned], axis=0)


def whole(samples, normal, materials):
    """The materials that a solve goes on with."""
    single = fit_material(samples, normal, shape=LAMBERT, shared=materials)
    found = with_whole_energy(samples, normal, materials, single, shape=LAMBERT)
    return materials if found is None else found


@pytest.mark.long
@pytest.mark.parametrize(("count", "degrees"), [(128, 16.0), (128, 10.0), (48, 16.0)])
def test_a_lobe_without_its_peak_gets_its_energy_back(device, count, degrees):
    """A lobe with the tail of the true one, which a robust fit finds. Within 5 %: sums over the lights stand for the energy of the lobe."""
    normal, lights = tilted(200, 60.0), sphere_directions(count)
    samples, _ = sample(blurred(normal, lights, degrees), device, lights=lights)
    normal = normal.astype(np.float32)
    shared = np.array([PAINT, [*np.array(GOLD) / 1.35, ROUGHNESS * 1.35**0.25]], np.float32)
    found = whole(samples, normal, shared)
    np.testing.assert_allclose(found[1, :3], GOLD, rtol=0.05)
    assert abs(found[1, 3] - ROUGHNESS) < 0.01 and (found[0] == shared[0]).all()


def test_a_lobe_that_explains_its_readings_stays(device):
    """To the last bit: right metals, metals of few pixels, and objects without any."""
    normal, lights = tilted(200, 60.0), sphere_directions(96)
    right = np.array([PAINT, [*GOLD, ROUGHNESS]], np.float32)
    low = np.array([PAINT, [*np.array(GOLD) / 1.35, ROUGHNESS * 1.35**0.25]], np.float32)
    for pixels, materials in ((200, right), (LEAST_PIXELS - 1, low), (200, right[:1])):
        samples, _ = sample(metal(normal[:pixels], ROUGHNESS**2, lights), device, lights=lights)
        few = normal[:pixels].astype(np.float32)
        np.testing.assert_array_equal(whole(samples, few, materials), materials)
