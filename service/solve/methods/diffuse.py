"""Normals and diffuse albedo by the methods that look at one pixel at a time: `lambert` and `robust`, band by band."""

from collections.abc import Callable

import numpy as np

from kernels.photometric.lambertian.albedo import fit_albedo
from kernels.photometric.lambertian.lambert import NormalFit
from kernels.photometric.lambertian.near import NearField
from kernels.photometric.lambertian.readings import Lights
from kernels.photometric.model.misfit import uncertainty_of
from kernels.status import Status
from service.solve.methods.misfit import object_misfit
from service.solve.sharing.batches import ReadBand, each_band
from service.solve.sharing.sharing import Results
from service.solve.sharing.solution import Solution, SolveInput


def solve_diffuse(given: SolveInput, lights: Lights, field: NearField | None = None, *, fit_normals: Callable[..., NormalFit]) -> Solution:
    """Solve every pixel of the mask for normal and diffuse albedo.

    Args:
        fit_normals: `solve_lambert` or `solve_robust`, which fits the normals of a band.
    """
    given.timings.stage("normals", given.stack.shape[2])
    result = Solution.empty(given.stack.pixel_count)
    result.sigma = np.zeros(given.stack.pixel_count, np.float16)
    misfit = object_misfit(given, lights, field, fit_normals=fit_normals)
    sigma = result.sigma

    def solve(read: ReadBand) -> None:
        span, inside, band, readings, near = read
        fit = fit_normals(band, readings, lights.direction, near)
        result.place(span, inside, fit)
        solved = inside & (result.status[span] == Status.OK)
        evidence = (array.numpy()[: len(inside)] for array in (fit.across, fit.squares, fit.freedom, fit.agreeing))
        sure = uncertainty_of(*evidence, misfit)
        sigma[span], result.confidence[span] = np.where(solved, sure.sigma, 0), np.where(solved, sure.confidence, 0)
        albedo = fit_albedo(band, readings, fit, lights, near).numpy()[:, : len(inside)]
        result.albedo[:, span] = np.where(inside, albedo, 0)

    each_band(given, lights, field, solve,
              Results((result.normal, result.albedo, result.confidence, result.residual, result.status, sigma), misfit))
    return result
