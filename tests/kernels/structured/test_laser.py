"""Laser spots and stripes: centres of known profiles, rays and planes of known geometry."""

import numpy as np
import pytest

from kernels.errors import ArrayError
from kernels.status import Status
from kernels.structured.stripe import find_stripe, plane_depths
from service.depth.laser.spot import find_spot, nearest_points


def spot(u, v, width, shape=(60, 80)):
    rows, cols = np.indices(shape) + 0.5
    return np.exp(-((cols - u) ** 2 + (rows - v) ** 2) / (2 * width**2)).astype(np.float32)


@pytest.mark.parametrize("width", [0.7, 1.5, 4.0])
@pytest.mark.parametrize("place", [(30.5, 20.5), (30.93, 20.21), (41.27, 33.68)])
def test_the_centroid_of_a_spot(place, width):
    found = find_spot(spot(*place, width))
    assert found.status == Status.OK
    # sampling at pixel centres
    assert np.hypot(found.u - place[0], found.v - place[1]) < (5e-3 if width < 1 else 2e-3)


def test_a_spot_in_noise_is_as_sure_as_it_says():
    rng = np.random.default_rng(5)
    off, said = [], []
    for _ in range(60):
        u, v = rng.uniform(20, 40, 2)
        found = find_spot(spot(u, v, 2.0) + rng.normal(0, 0.02, (60, 80)).astype(np.float32))
        off += [found.u - u, found.v - v]
        said.append(found.sigma_px)
    assert 0.7 < np.std(off) / np.mean(said) < 1.5  # which pixels are above the level is noisy as well


def test_weaker_spots_hot_pixels_and_saturation_do_not_move_it():
    image = np.minimum(spot(30.3, 20.6, 2.0), 0.6) + 0.5 * spot(60.0, 40.0, 3.0)
    image[5, 5] = 1.0
    found = find_spot(image)
    assert np.hypot(found.u - 30.3, found.v - 20.6) < 0.03


def test_where_there_is_no_spot():
    noise = np.random.default_rng(0).normal(0, 1, (60, 80)).astype(np.float32)
    assert find_spot(noise).status == Status.LOW_MODULATION
    assert find_spot(np.zeros((4, 4), np.float32)).status == Status.LOW_MODULATION
    assert find_spot(np.full((4, 4), np.nan, np.float32)).status == Status.LOW_MODULATION


def test_nearest_points_of_rays():
    """Closed form: the x axis, and a line along y that passes it at a distance of 0.2."""
    found = nearest_points(np.zeros(3), np.array([[2.0, 0, 0]]), np.array([[3.0, -1.0, 0.2]]), np.array([[0.0, 0.5, 0.0]]))
    assert np.allclose(found.point, [[3.0, 0.0, 0.1]]) and np.allclose(found.gap, 0.2)
    assert np.allclose(found.along_a, 3.0) and np.allclose(found.along_b, 1.0) and np.allclose(found.angle, np.pi / 2)
    assert np.isnan(nearest_points(np.zeros(3), np.array([[1.0, 0, 0]]), np.ones((1, 3)), np.array([[1.0, 0, 0]])).point).all()


@pytest.mark.long
@pytest.mark.parametrize("along", ["row", "column"])
@pytest.mark.parametrize("width", [0.8, 2.0, 5.0])
def test_the_centre_of_a_stripe(device, along, width):
    lines = np.arange(50)
    truth = 40.0 + 0.21 * lines
    image = np.exp(-((np.arange(100)[None] + 0.5 - truth[:, None]) ** 2) / (2 * width**2))
    found = find_stripe(image if along == "row" else image.T, along=along, noise=1e-4, device=device)
    assert (found.status.numpy() == Status.OK).all()
    assert np.abs(found.centre.numpy() - truth).max() < (5e-3 if width < 1 else 2e-3)  # sampling at pixel centres


def test_a_saturated_stripe_keeps_its_centre(device):
    truth = 50.0 + 0.13 * np.arange(40)
    image = np.minimum(2 * np.exp(-((np.arange(120)[None] + 0.5 - truth[:, None]) ** 2) / (2 * 2.5**2)), 1.0)
    found = find_stripe(image, along="row", noise=1e-4, device=device)
    assert np.abs(found.centre.numpy() - truth).max() < 0.03  # the clipped edges are sampled


def test_a_noisy_stripe_is_as_sure_as_it_says(device):
    rng, truth = np.random.default_rng(2), 50.0 + 0.013 * np.arange(800)
    image = np.exp(-((np.arange(120)[None] + 0.5 - truth[:, None]) ** 2) / (2 * 2.0**2)) + rng.normal(0, 0.02, (800, 120))
    found = find_stripe(image, along="row", noise=0.02, device=device)
    ok = found.status.numpy() == Status.OK
    assert ok.mean() > 0.99
    assert 0.7 < (found.centre.numpy() - truth)[ok].std() / found.sigma.numpy()[ok].mean() < 1.4


def patches(shape, contrast, seed):
    """[rows, cols] an albedo of fields of 2 × 2 pixels."""
    coarse = np.exp(np.random.default_rng(seed).normal(0, contrast, (shape[0] // 2, shape[1] // 2)))
    return coarse.repeat(2, axis=0).repeat(2, axis=1)


@pytest.mark.parametrize("width", [1.2, 2.0, 4.0])
def test_uneven_profiles_show_what_texture_does(device, width):
    truth, rng = 60.0 + 0.013 * np.arange(800), np.random.default_rng(4)
    plain = np.exp(-((np.arange(120)[None] + 0.5 - truth[:, None]) ** 2) / (2 * width**2))
    for image, texture in ((plain, False), (plain * np.exp(rng.normal(0, 0.2, plain.shape)), True)):
        found = find_stripe(image + rng.normal(0, 0.01, image.shape), along="row", noise=0.01, device=device)
        error = (found.centre.numpy() - truth).std()
        assert np.sqrt((found.uneven.numpy() ** 2).mean()) == pytest.approx(error, rel=0.2)
        assert (error > 5 * found.sigma.numpy().mean()) == texture
    np.testing.assert_allclose(np.median(find_stripe(plain, along="row", noise=1e-4, device=device).width.numpy()), width, rtol=0.02)


def test_a_known_albedo_is_divided_out(device):
    truth = 60.0 + 0.013 * np.arange(800)
    albedo = patches((800, 120), 0.4, 3)
    image = albedo * np.exp(-((np.arange(120)[None] + 0.5 - truth[:, None]) ** 2) / (2 * 2.0**2))
    image += np.random.default_rng(1).normal(0, 0.002, image.shape)
    raw, divided = (find_stripe(image, along="row", noise=0.002, device=device, albedo=known) for known in (None, albedo))
    assert (raw.centre.numpy() - truth).std() > 0.3 > 30 * (divided.centre.numpy() - truth).std()
    assert divided.even.numpy().all() and not raw.even.numpy().any()
    albedo[::2, 58:62] = 0  # not known in the middle of the stripe
    assert not find_stripe(image, along="row", noise=0.002, device=device, albedo=albedo).even.numpy()[:200:2].any()


def test_a_spot_on_texture_is_as_sure_as_it_says():
    rng, off, said = np.random.default_rng(5), [], []
    for number in range(80):
        u, v = rng.uniform(25, 35, 2)
        image = spot(u, v, 2.5) * patches((60, 80), 0.2, number) + rng.normal(0, 0.005, (60, 80))
        found = find_spot(image.astype(np.float32))
        off += [found.u - u, found.v - v]
        said += [found.sigma_px] * 2
    assert 0.7 < np.median(np.abs(off) / np.array(said)) / 0.6745 < 1.5  # 20 from noise alone


def test_lines_without_one_stripe_say_so(device):
    image = np.zeros((4, 300), np.float32)
    image[1, 20:23], image[1, 80:83] = 1.0, 0.9  # two
    image[2] = 1.0  # everywhere
    image[3, 298:] = 1.0  # cut by the border
    found = find_stripe(image, along="row", noise=0.01, device=device)
    assert list(found.status.numpy()) == [Status.LOW_MODULATION, Status.UNDECIDED, Status.UNDECIDED, Status.UNDECIDED]


def test_planes_of_light():
    """x = 0.1 + 0.2 z, from a laser beside the camera: n = (1, 0, -0.2)."""
    normal = np.array([1.0, 0.0, -0.2]) / np.hypot(1, 0.2)
    x = np.array([0.0, 0.05, -0.2, -0.5])
    found = plane_depths(x, np.zeros(4), np.array([0.1, 0.0, 0.0]), normal, along="row")
    truth = 0.1 / (x[:2] + 0.2)
    assert np.allclose(found.depth[:2], truth) and np.isnan(found.depth[2:]).all()  # parallel, and behind
    step = (0.1 / (x[:2] + 1e-7 + 0.2) - truth) / 1e-7
    assert np.allclose(found.per_pixel[:2], np.abs(step), rtol=1e-4)


def test_impossible_calls_are_refused(device):
    with pytest.raises(ArrayError, match="give row or column"):
        find_stripe(np.zeros((2, 2)), along="diagonal", noise=1.0, device=device)
    with pytest.raises(ArrayError, match="3-dimensional"):
        find_stripe(np.zeros((2, 2, 3)), along="row", noise=1.0, device=device)
