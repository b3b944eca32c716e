"""Normals and diffuse albedo by the methods that look at one pixel at a time: `lambert` and `robust`, band by band."""

from collections.abc import Callable

import numpy as np

from kernels.device import to_numpy
from kernels.photometric.lambertian.albedo import fit_albedo
from kernels.photometric.lambertian.lambert import NormalFit
from kernels.photometric.lambertian.near import NearField, see_near
from kernels.photometric.lambertian.readings import Lights, grey_factors, grey_readings
from kernels.photometric.model.misfit import Misfit, PairFits, albedo_error, measure_misfit, standard_error, with_bounced
from kernels.photometric.model.samples import some_of
from kernels.status import Status
from service.sharing.sharing import Results
from service.solve.base.batches import ReadBand, each_band
from service.solve.base.solution import Solution, SolveInput, half
from stage.colour.colour import GREY_WEIGHTS

MANY_CONTRADICTING = 0.2
"""Part of the readings to spare that contradicts the fits, from which it is said: plaster and real glazed figures have up to 0.12, scenes
with metal or many shadows more."""
PAIRS = 1024
"""Number of pairs, spread over the object."""
APART = 2
"""Pixels from the first to the second of a pair, in a row: the noise of neighbours is alike where colours are interpolated."""


def solve_diffuse(given: SolveInput, lights: Lights, field: NearField | None = None, *, fit_normals: Callable[..., NormalFit]) -> Solution:
    """Solve every pixel of the mask for normal and diffuse albedo.
    `fit_normals`: `solve_lambert` or `solve_robust`, which fits the normals of a band."""
    given.timings.stage("normals", given.stack.shape[2])
    result = Solution.empty(given.stack.pixel_count)
    own, tilt = result.albedo_own, result.albedo_tilt = np.zeros_like(result.albedo), np.zeros_like(result.albedo)
    misfit = _object_misfit(given, lights, field, fit_normals=fit_normals)
    if misfit.contradicting:
        result.facts["contradicting_readings"] = round(misfit.contradicting, 4)
    if misfit.contradicting > MANY_CONTRADICTING:
        result.warnings.append(f"{100 * misfit.contradicting:.0f} % of the readings that could check a normal contradict it, as shadows, "
                               "highlights and metal do: where few check it, sigma is wide; from eight lights on svbrdf is surer")

    def solve(read: ReadBand) -> None:
        span, inside, band, readings, near = read
        fit = fit_normals(band, readings, lights.direction, near)
        result.place(span, inside, fit)
        solved = inside & (result.status[span] == Status.OK)
        evidence = fit.across, fit.squares, fit.freedom, fit.spare, fit.agreeing
        across, squared, freedom, *checks = (to_numpy(array)[: len(inside)] for array in evidence)
        found = fit_albedo(band, readings, fit, lights, near)
        albedo, squares, openness, steep, bounced = (to_numpy(array)[..., : len(inside)] for array in found)
        result.sigma[span] = np.where(solved, with_bounced(standard_error(across, squared, freedom, *checks, misfit), bounced, misfit), 0)
        result.albedo[:, span] = np.where(inside, half(albedo), 0)
        own[:, span] = np.where(solved, half(albedo_error(albedo, squares, openness, bounced, freedom, misfit)), 0)
        tilt[:, span] = np.where(solved, half(albedo * np.radians(steep) / np.sqrt(2)), 0)  # half of σ² is along the steepest way

    each_band(given, lights, field, solve,
              Results((result.normal, result.albedo, result.sigma, result.residual, result.status, own, tilt), misfit))
    return result


def _object_misfit(given: SolveInput, lights: Lights, field: NearField | None = None, *, fit_normals: Callable[..., NormalFit]) -> Misfit:
    """Return the misfit of an object, from fits to pairs of its pixels.
    `fit_normals`: `solve_lambert` or `solve_robust`, which fits the normals of a band."""
    start = pair_starts(given.mask, PAIRS)
    if not len(start):
        return Misfit()
    pixels = np.concatenate([start, start + APART])
    band = given.images[given.device].pick(pixels)
    readings = grey_readings(band, grey_factors(lights, GREY_WEIGHTS))
    near = None if field is None else see_near(band, readings, field.at(pixels))
    values = readings.on_host(readings.values, len(pixels))
    fit = fit_normals(band, readings, lights.direction, near)
    if near is None:
        toward = np.broadcast_to(lights.direction.T[:, :, None], (3, *values.shape))
    else:
        toward = readings.on_host(near.toward, len(pixels))
    solved = (to_numpy(fit.status)[: len(pixels)] == Status.OK).reshape(2, -1).all(axis=0)
    # the fit has put its weights in place of the values
    weights = readings.on_host(readings.values, len(pixels))

    def pairs(array: np.ndarray) -> np.ndarray:
        return array[..., : len(pixels)].reshape(*array.shape[:-1], 2, -1)[..., solved]

    return measure_misfit(PairFits(pairs(values), pairs(weights), np.moveaxis(pairs(toward), 0, 1), pairs(to_numpy(fit.normal)),
                                   *(pairs(to_numpy(values)) for values in (fit.squares, fit.freedom, fit.spare, fit.agreeing))))


def pair_starts(mask: np.ndarray, most: int) -> np.ndarray:
    """Return the positions of the first pixels of up to `most` pairs, spread over a mask, [rows, cols] bool; the second lies APART on."""
    first = np.zeros(mask.shape, dtype=bool)
    first[:, :-APART] = mask[:, :-APART] & mask[:, APART:]
    return some_of(first, most)
