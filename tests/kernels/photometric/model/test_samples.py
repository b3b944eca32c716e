import numpy as np
import pytest

from kernels import packs
from kernels.photometric.lambertian.readings import grey_factors, grey_readings, pad_lights
from kernels.photometric.model.chosen_samples import choose
from kernels.photometric.model.samples import device_values, gather, host_values, per_pixel, to_host
from tests.kernels.scenes import GREY, store
from tests.reference.sampling import lattice

LIGHTS, PIXELS = 5, 75
DIRECTION = pad_lights(lattice(LIGHTS, 40), np.ones((LIGHTS, 3)))
RADIANCE = np.random.default_rng(0).uniform(0.1, 1, (3, LIGHTS, PIXELS))


def sampled(pixels, device):
    band = packs.upload(store(RADIANCE), device=device)
    view = np.random.default_rng(1).random((PIXELS, 3)).astype(np.float32)[pixels]
    return gather(band, np.asarray(pixels, np.int32), view, DIRECTION, grey_factors(DIRECTION, GREY), LIGHTS)


def on_host(samples):
    planes = [samples.grey, *(planes[c] for planes in (samples.colour, samples.toward) for c in range(3))]
    return np.stack([host_values(samples, plane) for plane in planes]), to_host(samples, samples.level), to_host(samples, samples.view)


@pytest.mark.parametrize("chosen", [[74, 3, 40, 3], [5], list(range(64)), np.arange(PIXELS) % 2 == 0])
def test_chosen_samples_are_those_of_their_pixels(chosen, device):
    whole = sampled(range(PIXELS), device)
    part = choose(whole, np.array(chosen))
    planes, level, view = on_host(whole)
    for ours, theirs in zip(on_host(part), (planes[:, chosen], level[chosen], view[chosen]), strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_one_pixel_is_as_one_of_many(device):
    one, many = sampled([7], device), sampled(range(PIXELS), device)
    for ours, theirs in zip(on_host(choose(one, np.array([0, 0]))), on_host(choose(many, np.array([7, 7]))), strict=True):
        np.testing.assert_array_equal(ours, theirs)
    values = np.arange(3.0, dtype=np.float32)[None]
    assert np.array_equal(to_host(one, per_pixel(one, values)), values)
    lit = np.arange(float(LIGHTS), dtype=np.float32)[None]
    assert np.array_equal(host_values(one, device_values(one, lit)), lit)


@pytest.mark.parametrize("pixels", [1, 4, 5])
def test_readings_of_one_pack_come_back_by_light(pixels, device):
    radiance = RADIANCE[:, :, :pixels]
    readings = grey_readings(packs.upload(store(radiance), device=device), grey_factors(DIRECTION, GREY))
    expected = np.einsum("c,clp->lp", GREY, store(radiance)[:, :LIGHTS].astype(float))
    np.testing.assert_allclose(readings.on_host(readings.values, pixels)[:LIGHTS], expected, rtol=1e-5)
