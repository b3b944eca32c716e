"""Standard errors of Lambertian normals against their true errors, in the model and out of it."""

import numpy as np
import pytest

from kernels import packs
from kernels.errors import ArrayError
from kernels.photometric.lambertian.lambert import solve_lambert
from kernels.photometric.lambertian.readings import grey_factors, grey_readings, pad_lights
from kernels.photometric.lambertian.robust import solve_robust
from kernels.photometric.model.misfit import Misfit, PairFits, measure_misfit
from kernels.status import Status
from tests.kernels.photometric.lambertian.test_robust import spoil
from tests.kernels.scenes import GREY, angle_degrees, shade, solve, store
from tests.reference.sampling import lattice

PIXELS = 600
NORMALS = lattice(PIXELS, 60)


def lambert(cosine):
    return np.maximum(cosine, 0)


def plastic(normal, direction):
    """A fall-off that is flatter than Lambert's, and a highlight some 30 degrees wide (Blinn)."""
    half = direction + [0, 0, 1]
    half /= np.linalg.norm(half, axis=1)[:, None]
    cosine = lambert(direction @ normal.T)
    return 0.5 * cosine**0.8 + 0.3 * np.maximum(half @ normal.T, 0) ** 40 * (cosine > 0)


def metal(normal, direction):
    half = direction + [0, 0, 1]
    half /= np.linalg.norm(half, axis=1)[:, None]
    return np.maximum(half @ normal.T, 0) ** 15 * (direction @ normal.T > 0)


def solved_twice(solver, clean, direction, noise, device, seed=0):
    """Two images of the same surface with independent shot noise: the first's fit, and the misfit that both tell."""
    rng = np.random.default_rng(seed)
    first, second = (np.maximum(clean + noise * np.sqrt(clean + 0.01) * rng.normal(size=clean.shape), 0) for _ in range(2))
    lights = pad_lights(direction, np.ones((len(direction), 3)))
    both = np.concatenate([first, second], axis=1)[None].repeat(3, axis=0)
    band = packs.upload(store(both), device=device)
    readings = grey_readings(band, grey_factors(lights, GREY))
    count = len(direction)
    values = readings.on_host(readings.values, 2 * PIXELS)[:count]
    fit = solver(band, readings, lights.direction)
    weights = readings.on_host(readings.values, 2 * PIXELS)[:count]
    ok = (fit.status.numpy()[: 2 * PIXELS] == Status.OK).reshape(2, PIXELS).all(axis=0)

    def pairs(array):
        return array[..., : 2 * PIXELS].reshape(*array.shape[:-1], 2, PIXELS)[..., ok]

    toward = np.broadcast_to(direction[:, :, None], (count, 3, 2 * PIXELS))
    misfit = measure_misfit(PairFits(pairs(values), pairs(weights), pairs(toward), pairs(fit.normal.numpy()),
                                     *(pairs(values.numpy()) for values in (fit.squares, fit.freedom, fit.spare, fit.agreeing))))
    return solve(solver, both[:, :, :PIXELS], direction, np.ones((count, 3)), device), misfit


def ratios(solver, clean, direction, noise, device):
    """Error over standard error of the solved pixels."""
    solved, misfit = solved_twice(solver, clean, direction, noise, device)
    sigma = solved.sigma(misfit)
    counted = (solved.status == Status.OK) & (sigma < 30)
    assert counted.mean() > 0.8
    return (angle_degrees(solved.normal, NORMALS) / sigma)[counted]


@pytest.mark.parametrize("lights, widest, noise", [(8, 60, 0.01), (12, 42, 0.003), (24, 75, 0.03), (96, 70, 0.003), (96, 45, 0.05)])
@pytest.mark.parametrize("shadows", [0.0, 0.15], ids=["clear", "shadowed"])
def test_in_the_model_the_error_is_that_of_the_noise(shadows, lights, widest, noise, device):
    direction = lattice(lights, widest)
    clean = 0.7 * lambert(direction @ NORMALS.T)
    if shadows and lights > 12:
        clean *= np.random.default_rng(1).random(clean.shape) > shadows
    ratio = ratios(solve_robust, clean, direction, noise, device)
    # 0.83 for an error that is the same in both directions across the normal, 0.67 for one in a single direction
    assert (0.5 if shadows else 0.62) < np.median(ratio) < 1.2  # under shadows a fit may be wrong
    assert (ratio > 5).mean() < 0.01


@pytest.mark.parametrize("solver", [solve_lambert, solve_robust])
@pytest.mark.parametrize("lights, widest, noise", [(12, 42, 0.01), (30, 60, 0.003), (96, 45, 0.003), (96, 75, 0.03)])
def test_misfit_counts_where_many_lights_average_the_noise(lights, widest, noise, solver, device):
    """Plastic: errors are 2 to 6 degrees, and those that noise explains a few tenths."""
    direction = lattice(lights, widest)
    ratio = ratios(solver, plastic(NORMALS, direction), direction, noise, device)
    assert 0.35 < np.median(ratio) < 1.6  # smoothness over the lights is assumed, and a highlight is not a random function
    assert (ratio > 5).mean() < 0.01


@pytest.mark.parametrize("shining", [0.1, 0.25])
def test_rejected_highlights_and_shadows_do_not_count(shining, device):
    """What is left is exact but for its noise, and the standard error is that of fewer readings."""
    rng = np.random.default_rng(3)
    direction, irradiance = lattice(40, 60), np.ones((40, 3))
    radiance = shade(NORMALS, np.full((PIXELS, 3), 0.7), direction, irradiance)
    spoiled, _ = spoil(radiance, irradiance, 0.2, shining)
    noise = 1 + 0.01 * rng.normal(size=(1, 40, PIXELS))
    known = Misfit(level=1e-4, residuals=np.array([1e-4]), share=np.zeros(1))
    clear, dirty = (solve(solve_robust, r * noise, direction, irradiance, device) for r in (radiance, spoiled))
    sigma = dirty.sigma(known)
    assert np.median(sigma) < 2 * np.median(clear.sigma(known))  # of half as many readings, and of noise that grows with them
    assert np.median(sigma) < 0.67 and np.median(dirty.residual) < 0.02
    assert 0.5 < np.median(angle_degrees(dirty.normal, NORMALS) / sigma) < 1.4


def test_a_fit_that_most_readings_contradict_is_unsure(device):
    """The lobe of a metal: its middle ranks look like another, Lambertian normal, tens of degrees off."""
    direction = lattice(60, 75)
    solved, misfit = solved_twice(solve_robust, metal(NORMALS, direction), direction, 0.003, device)
    sigma = solved.sigma(misfit)
    ok = solved.status == Status.OK
    wrong = ok & (angle_degrees(solved.normal, NORMALS) > 15)
    assert wrong.mean() > 0.5
    assert np.mean(sigma[wrong] < 9) < 0.01
    assert np.mean(angle_degrees(solved.normal, NORMALS)[ok] > 5 * sigma[ok]) < 0.01


@pytest.mark.parametrize("lights", [5, 6, 8, 10])
def test_fits_that_a_few_readings_agree_with_by_chance_are_unsure(lights, device):
    """Plaster with metal parts and cast shadows: three readings always fit some normal, and many do that are tens of degrees off."""
    rng = np.random.default_rng(lights)
    direction = lattice(lights, 60)
    clean = np.where(rng.random(PIXELS) < 0.2, metal(NORMALS, direction), 0.7 * lambert(direction @ NORMALS.T))
    clean = clean * np.where(rng.random(clean.shape) < 0.15, 0.05, 1)  # some light reaches shadows
    solved, misfit = solved_twice(solve_robust, clean, direction, 0.003, device)
    ok = solved.status == Status.OK
    error, sigma = angle_degrees(solved.normal, NORMALS)[ok], solved.sigma(misfit)[ok]
    assert np.mean(error > 15) > 0.05
    assert np.mean(error > 5 * sigma) < 0.01  # one in ten without what other pixels tell
    assert np.percentile(error / sigma, 95) < 3.5  # 2.4 is that of errors in two directions, 7 to 18 without what other pixels tell


@pytest.mark.parametrize("lights", [5, 6, 10])
def test_noise_alone_does_not_pass_for_contradiction(lights, device):
    solved, misfit = solved_twice(solve_robust, 0.7 * lambert(lattice(lights, 40) @ NORMALS.T), lattice(lights, 40), 0.02, device)
    ok = solved.status == Status.OK
    assert np.median(solved.sigma(misfit)[ok]) < 5 * np.median(angle_degrees(solved.normal, NORMALS)[ok])


def test_pairs_without_a_spare_reading_say_nothing():
    flat = np.zeros((2, 5))
    pairs = PairFits(np.ones((3, 2, 5)), np.ones((3, 2, 5)), np.ones((3, 3, 2, 5)), np.ones((3, 2, 5)), flat, flat, flat, flat)
    assert measure_misfit(pairs) is not None and measure_misfit(pairs).level == Misfit().level


def test_shapes_that_do_not_fit_are_refused():
    flat = np.ones((2, 5))
    with pytest.raises(ArrayError, match=r"readings are \(4, 2, 5\), weights \(3, 2, 5\)"):
        measure_misfit(PairFits(np.ones((4, 2, 5)), np.ones((3, 2, 5)), np.ones((4, 3, 2, 5)), np.ones((3, 2, 5)), flat, flat, flat, flat))
