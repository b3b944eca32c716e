"""Flying pixels, joint bilateral, wiggling and noise estimation."""

import numpy as np
import pytest
import warp as wp

from kernels.errors import ArrayError
from kernels.status import Status
from kernels.tof.continuous import bilateral
from kernels.tof.continuous.bilateral import smooth
from kernels.tof.continuous.continuous import Noise, decode, sample_harmonics, straighten
from kernels.tof.continuous.flying import mark_flying
from service.depth.tof.continuous_wave import estimate_noise
from tests.reference import tof


def on(device, *arrays):
    return [wp.array(np.ascontiguousarray(a).reshape(-1), device=device) for a in arrays]


def flying(distance, device, sigma=0.002, status=None, **options):
    distance = np.asarray(distance, dtype=np.float32)
    codes = np.full(distance.shape, int(Status.OK), np.int32) if status is None else status
    inputs = on(device, distance, np.full(distance.shape, sigma, np.float32), codes)
    return mark_flying(*inputs, *distance.shape, **options).numpy().reshape(distance.shape)


@pytest.mark.long
def test_a_column_between_two_walls_flies_and_no_other(device):
    distance = np.full((9, 12), 2.0)
    distance[:, 6:] = 5.0
    distance[:, 6] = 3.3
    assert (np.argwhere(flying(distance, device) == Status.FLYING)[:, 1] == 6).all()
    assert (flying(distance, device)[:, 6] == Status.FLYING).all()


def test_two_mixed_columns_fly(device):
    distance = np.full((9, 12), 2.0)
    distance[:, 5], distance[:, 6], distance[:, 7:] = 2.6, 4.1, 5.0
    assert (flying(distance, device)[:, 5:7] == Status.FLYING).all()


@pytest.mark.parametrize("name", ["slope", "step", "crease", "sphere", "wire"])
def test_surfaces_do_not_fly(name, device):
    v, u = np.mgrid[0:24, 0:32].astype(float)
    round_ = 81 - (u - 15) ** 2 - (v - 12) ** 2
    surfaces = {"slope": 1 + 0.2 * u, "step": np.where(u < 15, 2.0, 5.0), "crease": 2 + 0.1 * np.abs(u - 15),
                "sphere": np.where(round_ > 0, 3 - 0.1 * np.sqrt(np.clip(round_, 0, None)), 6.0),
                "wire": np.where(u == 15, 2.0, 5.0)}
    # the rim of a sphere nine pixels wide turns away within a pixel: some of it cannot be told from a mixture
    assert (flying(surfaces[name], device) == Status.OK).mean() > (0.95 if name == "sphere" else 0.99)


def test_invalid_neighbours_do_not_count_and_stay_what_they_are(device):
    distance = np.full((5, 9), 2.0)
    status = np.full((5, 9), int(Status.OK), np.int32)
    status[:, 5:] = int(Status.SATURATED)
    distance[:, 5:] = 0
    assert (flying(distance, device, status=status) == status).all()


def test_an_image_of_one_pixel_passes(device):
    assert flying([[2.0]], device)[0, 0] == Status.OK
    found = smooth(*on(device, np.float32([2]), np.float32([0.01]), np.float32([5]), np.int32([int(Status.OK)])), 1, 1)
    assert found.range.numpy()[0] == pytest.approx(2.0)
    assert found.sigma.numpy()[0] == pytest.approx(0.01, rel=1e-3)


def test_wrong_sizes_and_options_are_refused(device):
    arrays = on(device, np.ones((2, 3), np.float32), np.ones((2, 3), np.float32), np.ones((2, 3), np.int32))
    with pytest.raises(ArrayError, match="the image is 3 x 3"):
        mark_flying(*arrays, 3, 3)
    with pytest.raises(ArrayError, match="above zero"):
        mark_flying(*arrays, 2, 3, least_m=0.0)
    with pytest.raises(ArrayError, match="radius"):
        smooth(arrays[0], arrays[1], arrays[0], arrays[2], 2, 3, radius=0)
    with pytest.raises(ArrayError, match="a slice with gaps"):
        smooth(arrays[0][::2], arrays[1], arrays[0], arrays[2], 1, 3)


@pytest.mark.parametrize("cols", [24, 37, 64])  # rows of packs of eight pixels, of single ones, of the widest
def test_bilateral_is_that_of_the_twin(cols, device):
    rng = np.random.default_rng(5)
    rows = 13
    v, u = np.mgrid[0:rows, 0:cols]
    distance = (2 + 0.01 * u + np.where(u > 20, 1.0, 0) + rng.normal(0, 0.01, (rows, cols))).astype(np.float32)
    sigma = rng.uniform(0.005, 0.02, (rows, cols)).astype(np.float32)
    guide = (100 * (1 + (v > 6)) + rng.normal(0, 3, (rows, cols))).astype(np.float32)
    found = smooth(*on(device, distance, sigma, guide, np.full((rows, cols), int(Status.OK), np.int32)), rows, cols)
    twin, spread = tof.joint_bilateral(distance.astype(float), sigma.astype(float), guide.astype(float), radius=2, spatial=1.5,
                                       relative=bilateral.GUIDE_RELATIVE, sigmas=bilateral.RANGE_SIGMAS, step=bilateral.LEAST_STEP)
    # (1 - u/32)^16 in place of exp(-u/2): at most 2 % of a weight, on noise of a centimetre
    assert np.abs(found.range.numpy().reshape(rows, cols) - twin).max() < 5e-4
    np.testing.assert_allclose(found.sigma.numpy().reshape(rows, cols), spread, rtol=0.05)


def test_bilateral_keeps_slopes_edges_and_what_is_invalid(device):
    v, u = np.mgrid[0:16, 0:40].astype(float)
    distance = np.where(u < 20, 2 + 0.02 * u, 5 - 0.01 * v)
    guide = np.where((u // 4 + v // 4) % 2, 30.0, 200.0)  # albedo edges across the slope
    status = np.full(u.shape, int(Status.OK), np.int32)
    status[4:6, 7] = int(Status.LOW_MODULATION)
    distance[4:6, 7] = 0
    found = smooth(*on(device, distance.astype(np.float32), np.full(u.shape, 0.002, np.float32), guide.astype(np.float32), status), 16, 40)
    assert np.abs(found.range.numpy().reshape(u.shape) - distance).max() < 1e-3


def test_bilateral_lowers_the_noise_as_it_says(device):
    rng = np.random.default_rng(0)
    shape = (60, 80)
    noisy = (3 + rng.normal(0, 0.01, shape)).astype(np.float32)
    alike, ok = np.ones(shape, np.float32), np.full(shape, int(Status.OK), np.int32)
    found = smooth(*on(device, noisy, np.full(shape, 0.01, np.float32), alike, ok), *shape)
    inner = found.range.numpy().reshape(shape)[3:-3, 3:-3]
    assert inner.std() < 0.004
    assert found.sigma.numpy().reshape(shape)[3:-3, 3:-3].mean() == pytest.approx(inner.std(), rel=0.12)  # its own noise bends the weights


def test_wiggling_is_taken_out_by_the_table(device):
    delta = np.arange(4) * np.pi / 2
    true = np.linspace(0, 2 * np.pi, 2000, endpoint=False)
    waves = {3: 0.08, 5: -0.02}
    images = 500 + 300 * sum(weight * np.cos(n * (true - delta[:, None])) for n, weight in {1: 1.0, **waves}.items())
    found = decode(images.astype(np.float32), np.full(4, 20e6), delta, noise=Noise(1.0, 5.0), device=device)
    measured = found.phase.numpy()[0, :2000]
    error = np.angle(np.exp(1j * (measured - true)))
    assert np.abs(error).max() > 0.05
    angle = measured[:, None] * np.arange(13)
    terms = np.linalg.lstsq(np.concatenate([np.cos(angle), np.sin(angle)], axis=1), error, rcond=None)[0]
    straight = straighten(found, sample_harmonics(terms[:13], terms[13:])[None]).phase.numpy()[0, :2000]
    assert np.abs(np.angle(np.exp(1j * (straight - true)))).max() < 2e-3  # what is left: harmonics beyond the twelfth
    with pytest.raises(ArrayError, match="1 frequencies"):
        straighten(found, np.zeros((2, 512)))


@pytest.mark.parametrize("phases", [3, 4, 5])
def test_noise_is_estimated_from_the_images(phases):
    settings = tof.even(tof.HZ, phases)
    hz, delta = (np.array(column) for column in zip(*settings, strict=True))
    for gain in (1.0, 0.25):
        images = gain * tof.correlations(tof.room(), 1e5, settings, ambient=100, seed=phases).reshape(len(settings), -1)
        noise = estimate_noise(images.astype(np.float32), hz, delta, cols=128)
        level = np.array([100.0, 1000.0, 5000.0]) * gain
        expected = np.sqrt((5 * gain) ** 2 + gain * level)
        np.testing.assert_allclose(np.sqrt(noise.read**2 + noise.shot * level), expected, rtol=0.1)  # few pixels are as dark as the first


def test_noise_of_a_few_pixels_and_of_none():
    hz, delta = np.full(4, 20e6), np.arange(4) * np.pi / 2
    assert estimate_noise(np.full((4, 1), 7.0, np.float32), hz, delta, cols=1) == Noise(0.0, pytest.approx(0, abs=1e-6))
    assert estimate_noise(np.full((4, 4), 7.0, np.float32), hz, delta, cols=2, usable=np.zeros(4, bool)) == Noise(0.0, 0.0)
    with pytest.raises(ArrayError, match="three usable pixels in a row"):
        estimate_noise(np.full((3, 1), 7.0, np.float32), hz[:3], delta[:3], cols=1)
