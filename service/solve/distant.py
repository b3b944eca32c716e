"""Normals and reflectance by the methods that take one light a frame: `lambert` and `robust`, and `svbrdf`, which fits a material.

svbrdf walks over the image several times: a first search, the height that its normals give, the shadows and the interreflection
that follow from this height, the materials that pixels share, and the final solve.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import warp as wp

from kernels.photometric.albedo import fit_albedo
from kernels.photometric.bounce import subtract_bounce
from kernels.photometric.diffuse_shape import choose_diffuse
from kernels.photometric.hypotheses import Diffuse, Prior, search_normals
from kernels.photometric.lambert import NormalFit, solve_lambert
from kernels.photometric.left_out import LeftOut, leave_out
from kernels.photometric.lobes import GEOMETRY, MIXTURE
from kernels.photometric.material import MATT, fit_given, fit_tinted
from kernels.photometric.misfit import LARGEST_ERROR, uncertainty_of
from kernels.photometric.near import NearField
from kernels.photometric.readings import Lights, channel_weights, grey_factors, grey_readings, pad_lights
from kernels.photometric.robust import solve_robust
from kernels.photometric.samples import Samples, evenly
from kernels.photometric.shadowing import exclude_shadows
from kernels.photometric.shared_materials import choose_materials
from kernels.photometric.svbrdf import solve_svbrdf
from kernels.status import Status
from service.solve.batches import Batch, bands, pick_pixels, pixel_batches, view_directions
from service.solve.interreflection import arriving_light
from service.solve.misfit import object_misfit
from service.solve.solution import Solution, SolveInput, suspect_lights
from service.solve.surface import integrate, projection_of
from stage.colour import GREY_WEIGHTS
from stage.point_lights import DistantLights

SPREAD_PIXELS = 384
"""Pixels, spread over the object, from which the shape of the diffuse lobe and the shared materials are chosen."""
FEW_LIGHTS = 32
"""Fewer lights than this, four for each of the eight unknowns of a pixel, must show that they support the general solver."""
TESTED_LIGHTS = 6
"""With fewer lights than this none can be left out: those that remain would not determine what is tested."""
SUPPORTED_RATIO = 0.7
"""Largest misfit of left-out readings, over that of Lambert's law, at which the general solver is supported: 0.28 to 0.5 on objects where
its normals are better, real and path-traced, 0.9 and above where they follow errors of the lights."""
PRIOR_STRENGTH = 10.0
"""Strength of the prior towards the normals of `lambert` where the general solver is not supported: a standard deviation of some degrees
for a reading that misfits by the noise floor of the search."""
LARGEST_ALBEDO = 0.98
"""The part of light that a surface can send on; a fitted albedo may be larger where the scale of the lights is not absolute."""


@dataclass(frozen=True)
class MaterialOptions:
    """Steps of the svbrdf solver that can be left out, to measure what each contributes."""

    shadows: bool = True
    """Leave out readings in cast shadow."""
    interreflection: bool = True
    """Subtract the light that the object throws on itself."""
    sharing: bool = True
    """Let pixels share materials."""


WHOLE_SOLVER = MaterialOptions()


class NormalSolver(Protocol):
    """Solves the normals of every pixel of the mask from frames with one light each: `solve_diffuse` or `solve_material`."""

    def __call__(self, given: SolveInput, lights: Lights, field: NearField | None = None) -> Solution:
        """Return the solution.

        Args:
            given: the images.
            lights: lights of the stack, padded.
            field: where the lights are, and the surface point of each pixel, where some light is near.
        """


def solve_distant(given: SolveInput, lights: DistantLights, *, solver: NormalSolver) -> Solution:
    """Solve every pixel of the mask under distant lights, and name the lights that disagree with the others.

    Args:
        given: the images.
        lights: lights of the stack.
        solver: finds the normals.
    """
    padded = pad_lights(lights.direction, lights.irradiance, given.stack.scale)
    solution = solver(given, padded)
    solution.suspects = suspect_lights(solution, given.stack, padded)
    return solution


def solve_diffuse(given: SolveInput, lights: Lights, field: NearField | None = None, *, fit_normals: Callable[..., NormalFit]) -> Solution:
    """Solve every pixel of the mask for normal and diffuse albedo.

    Args:
        given: the images.
        lights: lights of the stack, padded.
        field: where the lights are, and the surface point of each pixel, where some light is near.
        fit_normals: `solve_lambert` or `solve_robust`, which fits the normals of a band.
    """
    given.timings.stage("normals", given.stack.shape[2])
    result = Solution.empty(given.stack.pixel_count)
    result.sigma = np.zeros(given.stack.pixel_count, np.float16)
    misfit = object_misfit(given, lights, field, fit_normals=fit_normals)
    for span, inside, band, readings, near in bands(given, lights, field):
        fit = fit_normals(band, readings, lights.direction, near)
        result.place(span, inside, fit)
        solved = inside & (result.status[span] == Status.OK)
        evidence = (array.numpy()[: len(inside)] for array in (fit.across, fit.squares, fit.freedom, fit.agreeing))
        sure = uncertainty_of(*evidence, misfit)
        result.sigma[span], result.confidence[span] = np.where(solved, sure.sigma, 0), np.where(solved, sure.confidence, 0)
        albedo = fit_albedo(band, readings, fit, lights, near).numpy()[:, : len(inside)]
        result.albedo[:, span] = np.where(inside, albedo, 0)
    return result


def solve_material(given: SolveInput, lights: Lights, field: NearField | None = None,
                   options: MaterialOptions = WHOLE_SOLVER) -> Solution:
    """Solve every pixel of the mask for normal, diffuse albedo, F0 and roughness.

    Args:
        given: the images.
        lights: lights of the stack, padded.
        field: where the lights are, and the surface point of each pixel, where some light is near; then interreflection is not
            subtracted.
        options: the steps that are left out.
    """
    stack, timings, view = given.stack, given.timings, view_directions(given.camera)
    result = Solution.empty(stack.pixel_count)
    result.specular = np.zeros((3, stack.pixel_count), np.float16)
    result.roughness = np.zeros(stack.pixel_count, np.float16)
    few = stack.light_count < FEW_LIGHTS
    lambertian = np.zeros_like(result.normal)
    timings.stage("start", stack.shape[2])
    for span, inside, band, readings, near in bands(given, lights, field):
        result.place(span, inside, solve_robust(band, readings, lights.direction, near))
        if few:
            fit = solve_lambert(band, grey_readings(band, grey_factors(lights, GREY_WEIGHTS)), lights.direction, near)
            lambertian[:, span] = np.where(fit.status.numpy()[: len(inside)] == Status.OK, fit.normal.numpy()[:, : len(inside)],
                                           result.normal[:, span])
    solvable = np.flatnonzero(result.status == Status.OK)
    spread = solvable[evenly(len(solvable), SPREAD_PIXELS)] if len(solvable) else solvable
    timings.stage("shape", 1)
    shape, supported = Diffuse(), True
    if len(spread):
        chosen = pick_pixels(given, lights, view, spread, field)
        if few:
            supported = _supported(result, chosen, result.normal[:, spread].T)
        if supported:
            shape, tried = choose_diffuse(chosen, result.normal[:, spread].T)
            result.facts |= {"diffuse_roughness": None if shape.rough < 0 else shape.rough, "diffuse_slope": shape.slope,
                             "shapes_tried": len(tried)}

    def prior(pixels: np.ndarray) -> Prior | None:
        """Return what is expected of the normals of some pixels."""
        return None if supported else Prior(lambertian[:, pixels].T, PRIOR_STRENGTH)

    def batches(stage: str) -> Iterator[Batch]:
        timings.stage(stage, len(solvable))
        done = 0
        for batch in pixel_batches(given, lights, view, solvable, lobes=MIXTURE + GEOMETRY, field=field):
            yield batch
            done += len(batch.pixels)
            timings.advance(done)

    interreflection = options.interreflection and field is None
    for pixels, samples in batches("search"):
        start = result.normal[:, pixels] if supported else lambertian[:, pixels]
        normal = search_normals(samples, start.T, shape=shape, prior=prior(pixels)).normal
        result.normal[:, pixels] = normal.T
        if interreflection:
            first = fit_tinted(samples, normal, shape=shape) if supported else fit_given(samples, normal, MATT, shape=shape)
            result.albedo[:, pixels], result.roughness[pixels] = first.diffuse_albedo.T, first.roughness
    solved = (result.status == Status.OK).reshape(given.mask.shape)
    surface = integrate(given, result.normal, solved, stage="surface")
    on_device = wp.array(solved.astype(np.uint8), dtype=wp.uint8, device=given.device)
    projection, arriving = projection_of(given.camera), None
    if interreflection and surface is not None:
        arriving = arriving_light(given, lights, result.normal, surface.height, solved)

    def clean(pixels: np.ndarray, samples: Samples) -> None:
        """Take cast shadows and interreflection, which follow from the height, out of the readings."""
        assert surface is not None  # there are pixels
        if options.shadows:
            exclude_shadows(samples, pixels, surface.height, on_device, projection, None if field is None else field.places)
        if arriving is not None:
            corners, shares = arriving.at(*np.divmod(pixels, given.camera.width))
            albedo = np.minimum(result.albedo[:, pixels].T.astype(np.float32), LARGEST_ALBEDO)
            subtract_bounce(samples, arriving.light, corners, shares, albedo, channel_weights(lights, GREY_WEIGHTS))

    materials, sigma = None, np.full(stack.pixel_count, LARGEST_ERROR, np.float16)
    if options.sharing and supported and len(spread):
        samples = pick_pixels(given, lights, view, spread, field)
        clean(spread, samples)
        materials = choose_materials(samples, result.normal[:, spread].T, shape=shape)
        result.facts["shared_materials"] = [{"specular": material[:3].tolist(), "roughness": float(material[3])}
                                            for material in materials.round(4).astype(float)]
    for pixels, samples in batches("normals"):
        clean(pixels, samples)
        found = solve_svbrdf(samples, result.normal[:, pixels].T, shape=shape, shared=materials,
                             roughness=result.roughness[pixels].astype(np.float32) if interreflection else None, prior=prior(pixels))
        result.normal[:, pixels] = found.normal.T
        result.albedo[:, pixels] = found.diffuse_albedo.T
        result.specular[:, pixels] = found.specular.T
        result.roughness[pixels] = found.roughness
        sigma[pixels], result.confidence[pixels] = found.sigma, found.confidence
        result.residual[pixels] = found.residual
    result.sigma, result.judged_by_surface = sigma, True
    return result


def _supported(result: Solution, samples: Samples, start: np.ndarray) -> bool:
    """Return whether few lights support the general solver, and say in the solution what speaks against it.

    Args:
        result: whose facts and warnings are added to.
        samples: some hundreds of pixels, spread over the object.
        start: [n, 3] unit normals to begin from.
    """
    count = samples.light_count
    fallback = ("normals are drawn to those of lambert and no specular lobe is estimated; capture 32 lights or more, "
                "spread over the hemisphere, or take --method robust")
    if count < TESTED_LIGHTS:
        result.warnings.append(f"method svbrdf: {count} lights are fewer than the unknowns of a pixel: {fallback}.")
        return False
    left: LeftOut = leave_out(samples, start)
    result.facts |= {"left_out_misfit": round(left.general, 4), "left_out_misfit_lambert": round(left.lambert, 4)}
    if left.ratio > SUPPORTED_RATIO:
        result.warnings.append(f"method svbrdf: the images of left-out lights are predicted hardly better with specular lobes than without "
                               f"(misfit {left.general:.2g} against {left.lambert:.2g}): {fallback}.")
    return left.ratio <= SUPPORTED_RATIO
