import numpy as np
import pytest

from kernels import packs
from kernels.errors import ArrayError
from kernels.photometric.lambertian.albedo import fit_albedo
from kernels.photometric.lambertian.lambert import NormalFit, solve_lambert
from kernels.photometric.lambertian.readings import Lights, grey_factors, grey_readings, pad_lights
from kernels.status import Status
from tests.kernels.scenes import GREY, cap, colours, rounding_bounds, shade, solve, store


def test_coloured_lights_of_unequal_strength(device):
    normal, albedo, direction = cap(200, 60), colours(200), cap(24, 70)
    irradiance = colours(24, seed=3) * 2.0 ** np.linspace(-3, 3, 24)[:, None]
    irradiance[::3, 2] = 0  # a third of the lights has no blue: grey comes from red and green
    solved = solve(solve_lambert, shade(normal, albedo, direction, irradiance), direction, irradiance, device)
    assert (solved.status == Status.OK).all()
    _, relative = rounding_bounds(normal, albedo[:, :2], direction, irradiance[:, :2], solved.weights > 0)
    assert (np.abs(solved.albedo / albedo - 1)[:, :2] <= relative[:, None] + 1e-5).all()
    # blue has two thirds of the lights, so the turn of the normal counts for more in it, by less than twice
    assert (np.abs(solved.albedo / albedo - 1)[:, 2] <= 2 * relative + 1e-5).all()


def test_the_scale_of_each_stored_image_is_undone(device):
    normal, albedo, direction, irradiance = cap(50, 60), colours(50), cap(9, 60), 3 * colours(9, seed=1)
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


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("lacks", [0, 2], ids=["no red", "no blue"])
def test_a_value_that_is_not_finite_costs_its_light_alone(lacks, bad, device):
    normal, albedo, direction = cap(40, 50), colours(40), cap(16, 60)
    irradiance = np.ones((16, 3))
    irradiance[0, lacks] = 0  # so that this channel is no part of grey
    radiance = shade(normal, albedo, direction, irradiance)
    radiance[2, 5], radiance[2, 6, ::2] = bad, bad
    solved = solve(solve_lambert, radiance, direction, irradiance, device)
    assert (solved.weights[5] == 0).all() and (solved.weights[6, 1::2] == 1).all()
    _, relative = rounding_bounds(normal, albedo, direction, np.ones((16, 3)), solved.weights > 0)
    assert (np.abs(solved.albedo / albedo - 1) <= 1.1 * relative[:, None] + 1e-5).all()  # one light fewer in one channel


def test_negative_channels_give_albedo_zero(device):
    normal, direction = cap(3, 30), cap(8, 40)
    radiance = shade(normal, np.ones((3, 3)), direction, np.ones((8, 3)))
    radiance[2] = -1e-3  # blue: dark frame noise, on a surface that reflects none
    solved = solve(solve_lambert, radiance, direction, np.ones((8, 3)), device)
    assert (solved.status == Status.OK).all() and (solved.albedo[:, 2] == 0).all() and (solved.albedo[:, :2] > 0.9).all()


def test_unusable_arguments_are_refused(device):
    lights = pad_lights(cap(8, 40), np.ones((8, 3)))
    band = packs.upload(np.ones((3, 8, 4), dtype=np.float16), device=device)
    readings = grey_readings(band, grey_factors(lights, GREY))
    fit: NormalFit = solve_lambert(band, readings, lights.direction)
    with pytest.raises(ArrayError, match="irradiance is 0 in channel G of every light: its albedo"):
        fit_albedo(band, readings, fit, Lights(lights.direction, lights.irradiance * [1, 0, 1], lights.scale))
    with pytest.raises(ArrayError, match="there are 16 padded lights, the band has 8"):
        fit_albedo(band, readings, fit, pad_lights(cap(9, 40), np.ones((9, 3))))
