"""Stack → normals and reflectance by the methods that take one light a frame, band by band."""

import numpy as np

from kernels import packs
from kernels.photometric.albedo import fit_albedo
from kernels.photometric.lambert import solve_lambert
from kernels.photometric.near import NearField, see_near
from kernels.photometric.readings import Lights, grey_factors, grey_readings
from kernels.photometric.robust import solve_robust
from service.reporting.progress import Timings
from service.requests.solve import Method
from service.solve.material import solve_material
from service.solve.solution import NEAR_BYTES, READING_BYTES, Solution
from stage.camera import Camera
from stage.colour import GREY_WEIGHTS
from stage.stack import Stack


def solve_normals(method: Method, stack: Stack, lights: Lights, camera: Camera, mask: np.ndarray, device: str,
                  timings: Timings, field: NearField | None = None) -> Solution:
    """Solve every pixel of the mask with one of the methods that take one light a frame.

    Args:
        method: lambert, robust or svbrdf.
        stack: the images.
        lights: of the stack, padded.
        camera: of the capture; says which way the viewer is.
        mask: [rows, cols] bool.
        device: where.
        timings: told of every stage.
        field: where the lights are, and the point of each pixel, where some light is near.
    """
    if method is Method.SVBRDF:
        return solve_material(stack, lights, camera, mask, device, timings, field)
    solver = {Method.LAMBERT: solve_lambert, Method.ROBUST: solve_robust}[method]
    timings.stage("normals", stack.shape[2])
    result = Solution.empty(stack.pixel_count)
    factors = grey_factors(lights, GREY_WEIGHTS)
    inside = mask.reshape(-1)
    for start, stop in stack.bands((READING_BYTES if field is None else NEAR_BYTES) * stack.shape[1]):
        here = slice(start, min(stop, stack.pixel_count))
        if inside[here].any():
            band = packs.upload(stack.band(start, stop), stack.saturated(start, stop), device=device)
            readings = grey_readings(band, factors)
            near = None if field is None else see_near(band, readings, field.at(np.arange(start, stop)))
            fit = solver(band, readings, lights.direction, near)
            result.place(here, inside[here], fit)
            albedo = fit_albedo(band, readings, fit, lights, near).numpy()[:, : here.stop - start]
            result.albedo[:, here] = np.where(inside[here], albedo, 0)
        timings.advance(stop)
    return result
