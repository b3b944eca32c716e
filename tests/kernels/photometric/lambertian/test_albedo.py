import numpy as np
import pytest

from kernels import packs
from kernels.errors import ArrayError
from kernels.photometric.lambertian.albedo import fit_albedo
from kernels.photometric.lambertian.lambert import NormalFit, solve_lambert
from kernels.photometric.lambertian.readings import Lights, grey_factors, grey_readings, pad_lights
from kernels.photometric.model.misfit import Misfit, albedo_error
from kernels.status import Status
from tests.kernels.scenes import GREY, colours, rounding_bounds, shade, solve, store
from tests.reference.sampling import lattice


def test_coloured_lights_of_unequal_strength(device):
    normal, albedo, direction = lattice(200, 60), colours(200), lattice(24, 70)
    irradiance = colours(24, seed=3) * 2.0 ** np.linspace(-3, 3, 24)[:, None]
    irradiance[::3, 2] = 0  # a third of the lights has no blue: grey comes from red and green
    solved = solve(solve_lambert, shade(normal, albedo, direction, irradiance), direction, irradiance, device)
    assert (solved.status == Status.OK).all()
    _, relative = rounding_bounds(normal, albedo[:, :2], direction, irradiance[:, :2], solved.weights > 0)
    assert (np.abs(solved.albedo / albedo - 1)[:, :2] <= relative[:, None] + 1e-5).all()
    # blue has two thirds of the lights, so the turn of the normal counts for more in it, by less than twice
    assert (np.abs(solved.albedo / albedo - 1)[:, 2] <= 2 * relative + 1e-5).all()


def test_the_scale_of_each_stored_image_is_undone(device):
    normal, albedo, direction, irradiance = lattice(50, 60), colours(50), lattice(9, 60), 3 * colours(9, seed=1)
    radiance, scale = shade(normal, albedo, direction, irradiance), 2.0 ** np.arange(-4, 5)
    results = []
    for stored, s in ((radiance, None), (radiance / scale[None, :, None], scale)):
        lights = pad_lights(direction, irradiance, s)
        band = packs.upload(store(stored), device=device)
        readings = grey_readings(band, grey_factors(lights, GREY))
        fit = solve_lambert(band, readings, lights.direction)
        results.append((fit.normal.numpy(), fit_albedo(band, readings, fit, lights).albedo.numpy()))
    np.testing.assert_allclose(results[1][0], results[0][0], atol=1e-3)  # half steps of the darkest light, scaled by 16
    np.testing.assert_allclose(results[1][1], results[0][1], atol=1e-3)


def test_a_dark_image_that_is_stored_as_a_bright_one_counts_no_more_than_others(device):
    """The reading of a grazing light, mostly bounced, is stored 64 times brighter: it shifts the albedo by what it is worth."""
    direction = np.vstack([lattice(15, 60), [[np.sqrt(1 - 0.01**2), 0, 0.01]]])
    radiance = shade(np.array([[0.0, 0.0, 1.0]]), np.full((1, 3), 0.5), direction, np.ones((16, 3)))
    radiance[:, -1] += 0.01
    scale = np.array([1.0] * 15 + [1 / 64])
    lights = pad_lights(direction, np.ones((16, 3)), scale)
    band = packs.upload(store(radiance / scale[None, :, None]), device=device)
    readings = grey_readings(band, grey_factors(lights, GREY))
    found = fit_albedo(band, readings, solve_lambert(band, readings, lights.direction), lights)
    np.testing.assert_allclose(found.albedo.numpy()[:, 0], 0.5, rtol=0.02)  # the normal turns by half a degree


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("lacks", [0, 2], ids=["no red", "no blue"])
def test_a_value_that_is_not_finite_costs_its_light_alone(lacks, bad, device):
    normal, albedo, direction = lattice(40, 50), colours(40), lattice(16, 60)
    irradiance = np.ones((16, 3))
    irradiance[0, lacks] = 0  # so that this channel is no part of grey
    radiance = shade(normal, albedo, direction, irradiance)
    radiance[2, 5], radiance[2, 6, ::2] = bad, bad
    solved = solve(solve_lambert, radiance, direction, irradiance, device)
    assert (solved.weights[5] == 0).all() and (solved.weights[6, 1::2] == 1).all()
    _, relative = rounding_bounds(normal, albedo, direction, np.ones((16, 3)), solved.weights > 0)
    assert (np.abs(solved.albedo / albedo - 1) <= 1.1 * relative[:, None] + 1e-5).all()  # one light fewer in one channel


def solve_albedo(radiance, direction, device):
    """The albedo of Lambertian pixels and what its error follows from, without padding, and the freedom of their normals."""
    lights, pixels = pad_lights(direction, np.ones_like(direction)), radiance.shape[2]
    band = packs.upload(store(radiance), device=device)
    readings = grey_readings(band, grey_factors(lights, GREY))
    fit = solve_lambert(band, readings, lights.direction)
    found = [array.numpy()[..., :pixels] for array in fit_albedo(band, readings, fit, lights)]
    return *found, fit.freedom.numpy()[:pixels]


def test_the_error_of_the_albedo_under_a_given_normal_is_that_of_its_noise(device):
    """400 draws of two percent on one surface: the spread of the draws is known to 4 %, what the residuals tell to as much. Lights all
    around the normal leave its error without effect on the albedo."""
    normal, direction = np.tile([0.0, 0.0, 1.0], (400, 1)), lattice(24, 60)
    noise = 1e-2 * np.random.default_rng(1).normal(size=(3, 24, 400)) / np.pi
    radiance = shade(normal, np.full((400, 3), 0.5), direction, np.ones((24, 3))) + noise
    found, squares, openness, _, bounced, freedom = solve_albedo(radiance, direction, device)
    sigma = albedo_error(found, squares, openness, bounced, freedom, Misfit(level=4e-4, share=np.zeros(1), residuals=np.array([4e-4])))
    np.testing.assert_allclose(np.sqrt((sigma**2).mean(axis=1)), found.std(axis=1), rtol=0.12)
    assert (bounced == -1).all()  # all lights stand before the surface


def test_albedo_follows_a_tilted_normal_by_the_slope_that_is_told(device):
    """Under lights from one side a normal that turns by a small angle along the steepest way changes the albedo by that much of it.
    Tolerance: the second order of one degree, and halves."""
    direction = lattice(24, 50) + [0.8, 0.0, 0.0]
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    cosine = direction[:, 2]
    slope = (cosine[:, None] * direction)[:, :2].sum(axis=0) / (cosine**2).sum()
    turned = np.radians(1.0) * slope / np.linalg.norm(slope)
    tilted = np.array([*turned, 1.0]) / np.linalg.norm([*turned, 1.0])
    readings = shade(np.array([[0.0, 0.0, 1.0]]), np.full((1, 3), 0.5), direction, np.ones((24, 3)))
    expected = (readings[0, :, 0] * (direction @ tilted)).sum() / ((direction @ tilted) ** 2).sum() * np.pi
    _, _, _, tilt, _, _ = solve_albedo(readings, direction, device)
    assert tilt[0] * np.radians(1.0) == pytest.approx(abs(expected / 0.5 - 1), rel=0.03)


def test_light_under_lights_behind_the_surface_is_measured(device):
    """A third of the lights stands behind the surface, where each reading is 4 % of that along the normal."""
    direction = lattice(48, 120)
    radiance = shade(np.tile([0.0, 0.0, 1.0], (5, 1)), np.full((5, 3), 0.5), direction, np.ones((48, 3)))
    glow = np.where(direction[:, 2] < 0, 0.04 * 0.5 / np.pi, 0)[None, :, None]
    _, _, _, _, bounced, _ = solve_albedo(radiance + glow, direction, device)
    # least squares over readings from behind turn nothing and dim the albedo by some percent of 4 %
    np.testing.assert_allclose(bounced, 0.04, rtol=0.05)


def test_negative_channels_give_albedo_zero(device):
    normal, direction = lattice(3, 30), lattice(8, 40)
    radiance = shade(normal, np.ones((3, 3)), direction, np.ones((8, 3)))
    radiance[2] = -1e-3  # blue: dark frame noise, on a surface that reflects none
    solved = solve(solve_lambert, radiance, direction, np.ones((8, 3)), device)
    assert (solved.status == Status.OK).all() and (solved.albedo[:, 2] == 0).all() and (solved.albedo[:, :2] > 0.9).all()


def test_unusable_arguments_are_refused(device):
    lights = pad_lights(lattice(8, 40), np.ones((8, 3)))
    band = packs.upload(np.ones((3, 8, 4), dtype=np.float16), device=device)
    readings = grey_readings(band, grey_factors(lights, GREY))
    fit: NormalFit = solve_lambert(band, readings, lights.direction)
    with pytest.raises(ArrayError, match="irradiance is 0 in channel G of every light: its albedo"):
        fit_albedo(band, readings, fit, Lights(lights.direction, lights.irradiance * [1, 0, 1], lights.scale))
    with pytest.raises(ArrayError, match="there are 16 padded lights, the band has 8"):
        fit_albedo(band, readings, fit, pad_lights(lattice(9, 40), np.ones((9, 3))))
