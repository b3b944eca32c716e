"""Metals that turn within a pixel, of which no single lobe explains the readings: light that dielectrics lose in their place, and what the
moments of the readings say."""

import numpy as np
import pytest

from kernels.photometric.material.blurred_metals import find_blurred_metals
from kernels.photometric.material.lost_light import account_light
from kernels.photometric.material.material import Material
from tests.kernels.photometric.material.test_metal_energy import blurred
from tests.kernels.photometric.material.test_mixtures import GOLD, metal
from tests.kernels.photometric.test_svbrdf import COLOUR, degrees, render, sample, tilted
from tests.marks import first_short
from tests.scenes.glossy import sphere_directions

COUNT = 200
NORMAL, ROUGHNESS = tilted(COUNT, 60.0), 0.28


def of_one_material(albedo, f0, roughness, *, count=COUNT):
    """The same material at every pixel."""
    return Material(np.tile(np.float32(albedo), (count, 1)), np.tile(np.float32(f0), (count, 1)), np.full(count, roughness, np.float32),
                    np.zeros(count, np.float32))


@pytest.mark.parametrize("count", [48, 128])
def test_the_light_that_a_material_loses(device, count):
    """A dielectric with the dim readings of a metal loses its highlight: of 200 pixels some, at 48 lights, show none. Right materials lose
    nothing. Half floats of the stack: 0.001."""
    lights = sphere_directions(count)
    gold, _ = sample(metal(NORMAL, ROUGHNESS**2, lights), device, lights=lights)
    dark = of_one_material([0.05, 0.04, 0.02], [0.04] * 3, 0.4)
    assert (account_light(gold, NORMAL, dark).misread > 0.5).mean() > 0.9
    assert not account_light(gold, NORMAL, of_one_material([0] * 3, GOLD, ROUGHNESS)).misread.any()
    paint, _ = sample(render(NORMAL, alpha=0.3**2, f0=0.08, lights=lights), device, lights=lights)
    assert not account_light(paint, NORMAL, of_one_material(COLOUR, [0.08] * 3, 0.3)).misread.any()
    matt = of_one_material(COLOUR, [0.0] * 3, 1.0)  # loses the highlights of a dielectric
    assert (account_light(paint, NORMAL, matt).misread > 0).mean() < 0.15


@first_short(("count", "turn"), [(128, 16.0), (128, 30.0), (64, 30.0)])
def test_normal_and_f0_of_a_metal_that_turns_within_a_pixel(device, count, turn):
    """Lights stand 18° apart (128) or 25°, half vectors half as far, of which the normal is a mean; a sixth is asked of the spacing of
    the lights. F0 is a sum over few lights: 15 %. The lobe is at least as wide as the material's. σ holds the errors."""
    lights = sphere_directions(count)
    samples, _ = sample(blurred(NORMAL, lights, turn), device, lights=lights)
    found = find_blurred_metals(samples)
    off = degrees(found.normal, NORMAL)
    assert np.median(off) < np.degrees(np.sqrt(4 * np.pi / count)) / 6
    np.testing.assert_allclose(np.median(found.specular, axis=0), GOLD, rtol=0.15)
    assert np.median(found.roughness) > ROUGHNESS
    assert np.percentile(off / found.sigma, 95) < 2
    assert (np.abs(np.linalg.norm(found.normal, axis=1) - 1) < 1e-5).all()
