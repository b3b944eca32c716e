"""Stack → normals and reflectance, band by band: where the solvers of kernels/ meet the stack of stage/."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from kernels import packs
from kernels.photometric.albedo import fit_albedo
from kernels.photometric.diffuse_shape import choose_diffuse
from kernels.photometric.hypotheses import GEOMETRY, MIXTURE, Diffuse
from kernels.photometric.lambert import NormalFit, solve_lambert
from kernels.photometric.readings import Lights, grey_factors, grey_readings
from kernels.photometric.robust import solve_robust
from kernels.photometric.samples import Samples, gather
from kernels.photometric.svbrdf import solve_svbrdf
from kernels.status import Status
from service.methods import Method
from service.progress import Timings
from stage.camera import Camera
from stage.colour import GREY_WEIGHTS
from stage.stack import Stack

READING_BYTES = 4
"""A grey reading, per light and pixel, beside the stack's band."""
SAMPLE_BYTES = 4 * (4 + 3 + MIXTURE + GEOMETRY)
"""Of the general solver, per light and pixel: grey and colour readings, direction, lobes."""
BATCH_BYTES = 256 << 20
"""Of samples that are solved at one time."""
SHAPE_PIXELS = 384
"""Pixels, spread over the object, from which the shape of the diffuse lobe is chosen."""


@dataclass
class Solution:
    """What a solver found at every pixel of the image; only pixels with status OK have values."""

    normal: np.ndarray  # [3, pixels] float32
    albedo: np.ndarray  # [3, pixels] float16
    confidence: np.ndarray  # [pixels] float16
    residual: np.ndarray  # [pixels] float16
    status: np.ndarray  # [pixels] uint8
    specular: np.ndarray | None = None  # [3, pixels] float16, F0
    roughness: np.ndarray | None = None  # [pixels] float16
    specular_normal: np.ndarray | None = None  # [3, pixels] float32, of the highlight; 0 where none was found
    facts: dict[str, Any] | None = None  # for the report

    @classmethod
    def empty(cls, pixels: int) -> "Solution":
        """Nothing solved yet."""
        return cls(np.zeros((3, pixels), np.float32), np.zeros((3, pixels), np.float16), np.zeros(pixels, np.float16),
                   np.zeros(pixels, np.float16), np.zeros(pixels, np.uint8))


def solve_normals(method: Method, stack: Stack, lights: Lights, camera: Camera, mask: np.ndarray, device: str,
                  timings: Timings) -> Solution:
    """Solve every pixel of the mask with one of the methods for distant lights.

    Args:
        method: lambert, robust or svbrdf.
        stack: the images.
        lights: of the stack, padded.
        camera: of the capture; says which way the viewer is.
        mask: [rows, cols] bool.
        device: where.
        timings: told of every stage.
    """
    if method is Method.SVBRDF:
        return _solve_material(stack, lights, camera, mask, device, timings)
    solver = {Method.LAMBERT: solve_lambert, Method.ROBUST: solve_robust}[method]
    timings.stage("normals", stack.shape[2])
    result = Solution.empty(stack.pixel_count)
    factors = grey_factors(lights, GREY_WEIGHTS)
    inside = mask.reshape(-1)
    for start, stop in stack.bands(READING_BYTES * stack.shape[1]):
        here = slice(start, min(stop, stack.pixel_count))
        if inside[here].any():
            band = packs.upload(stack.band(start, stop), stack.saturated(start, stop), device=device)
            readings = grey_readings(band, factors)
            fit = solver(band, readings, lights.direction)
            albedo = fit_albedo(band, readings, fit, lights)
            count, kept = here.stop - start, inside[here]
            _place(result, here, kept, fit)
            result.albedo[:, here] = np.where(kept, albedo.numpy()[:, :count], 0)
        timings.advance(stop)
    return result


def _place(result: Solution, here: slice, kept: np.ndarray, fit: NormalFit) -> None:
    count = len(kept)
    result.normal[:, here] = np.where(kept, fit.normal.numpy()[:, :count], 0)
    result.confidence[here] = np.where(kept, fit.confidence.numpy()[:count], 0)
    result.residual[here] = np.where(kept, fit.residual.numpy()[:count], 0)
    result.status[here] = np.where(kept, fit.status.numpy()[:count], int(Status.UNSOLVED))


def _solve_material(stack: Stack, lights: Lights, camera: Camera, mask: np.ndarray, device: str, timings: Timings) -> Solution:
    """The general solver: start from `robust`, choose the diffuse shape on some pixels, then solve all in batches."""
    pixels, count = stack.pixel_count, stack.light_count
    factors = grey_factors(lights, GREY_WEIGHTS)
    view = view_directions(camera)
    inside = np.flatnonzero(mask.reshape(-1))
    timings.stage("shape", 1)
    shape, tried = _shape(stack, lights, factors, view, inside, device)
    timings.stage("normals", len(inside))
    result = Solution.empty(pixels)
    result.specular, result.roughness = np.zeros((3, pixels), np.float16), np.zeros(pixels, np.float16)
    result.facts = {"diffuse_roughness": None if shape.rough < 0 else shape.rough, "diffuse_slope": shape.slope,
                    "shapes_tried": len(tried)}
    batch = max(1, BATCH_BYTES // (SAMPLE_BYTES * count))
    done = 0
    for start, stop in stack.bands(READING_BYTES * stack.shape[1]):
        here = slice(start, min(stop, pixels))
        local = inside[(inside >= start) & (inside < here.stop)] - start
        if len(local):
            band = packs.upload(stack.band(start, stop), stack.saturated(start, stop), device=device)
            fit = solve_robust(band, grey_readings(band, factors), lights.direction)
            kept = np.zeros(here.stop - start, dtype=bool)
            kept[local] = True
            _place(result, here, kept, fit)
            solved = local[result.status[start + local] == Status.OK]
            for first in range(0, len(solved), batch):
                part = solved[first : first + batch]
                where = start + part
                samples = gather(band, part, view(where), lights, factors, count)
                found = solve_svbrdf(samples, result.normal[:, where].T, shape=shape)
                result.normal[:, where] = found.normal.T
                result.albedo[:, where] = found.diffuse_albedo.T
                result.specular[:, where] = found.specular.T
                result.roughness[where] = found.roughness
                result.confidence[where] = found.confidence
                result.residual[where] = found.residual
                timings.advance(done + first + len(part))
        done += len(local)
        timings.advance(done)
    return result


def _shape(stack: Stack, lights: Lights, factors: np.ndarray, view: Callable[[np.ndarray], np.ndarray], inside: np.ndarray,
           device: str) -> tuple[Diffuse, np.ndarray]:
    """The diffuse shape, from pixels at even steps through the mask."""
    chosen = inside[np.unique(np.linspace(0, len(inside) - 1, min(SHAPE_PIXELS, len(inside))).astype(int))]
    band = packs.upload(*stack.pick(chosen), device=device)
    fit = solve_robust(band, grey_readings(band, factors), lights.direction)
    solved = np.flatnonzero(fit.status.numpy()[: len(chosen)] == Status.OK)
    if not len(solved):
        return Diffuse(), np.zeros((0, 3))
    samples: Samples = gather(band, solved, view(chosen[solved]), lights, factors, stack.light_count)
    return choose_diffuse(samples, fit.normal.numpy()[:, solved].T)


def view_directions(camera: Camera) -> Callable[[np.ndarray], np.ndarray]:
    """A function from pixel positions (row-major, [n]) to unit directions to the viewer [n, 3] float32."""
    if camera.projection == "orthographic":
        return lambda positions: np.tile(np.array([0, 0, 1], dtype=np.float32), (len(positions), 1))
    x, y = (plane.reshape(-1) for plane in camera.plane_coordinates())

    def towards(positions: np.ndarray) -> np.ndarray:
        rays = np.stack([-x[positions], -y[positions], np.ones(len(positions))], axis=1)
        return (rays / np.linalg.norm(rays, axis=1, keepdims=True)).astype(np.float32)

    return towards
