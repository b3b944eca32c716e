"""The general solver over an image: a first search, the height it gives, the shadows and the light that this height throws on itself,
the materials that pixels share, and the final solve."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import warp as wp

from kernels import packs
from kernels.photometric.bounce import subtract_bounce
from kernels.photometric.diffuse_shape import choose_diffuse
from kernels.photometric.hypotheses import Diffuse, search_normals
from kernels.photometric.lobes import GEOMETRY, MIXTURE
from kernels.photometric.material import fit_tinted
from kernels.photometric.near import NearField, see_near
from kernels.photometric.readings import Lights, channel_weights, grey_factors, grey_readings
from kernels.photometric.robust import solve_robust
from kernels.photometric.samples import Samples, evenly, gather
from kernels.photometric.shadowing import exclude_shadows
from kernels.photometric.shared_materials import choose_materials
from kernels.photometric.svbrdf import solve_svbrdf
from kernels.status import Status
from kernels.surface.shadows import Projection
from service.reporting.progress import Timings
from service.solve.batches import Batch, View, pixel_batches, view_directions
from service.solve.height import integrate
from service.solve.interreflection import arriving_light
from service.solve.solution import NEAR_BYTES, READING_BYTES, Solution
from stage.camera import Camera
from stage.colour import GREY_WEIGHTS
from stage.stack import Stack

SPREAD_PIXELS = 384
"""Pixels, spread over the object, from which the shape of the diffuse lobe and the shared materials are chosen."""

LARGEST_ALBEDO = 0.98
"""What a surface can send on; a fitted albedo may be larger where the scale of the lights is not absolute."""


@dataclass(frozen=True)
class Parts:
    """Parts of the solver that can be left out, to see what each buys."""

    shadows: bool = True
    """Cast shadows are taken out."""
    bounce: bool = True
    """Light that the object throws on itself is taken off."""
    sharing: bool = True
    """Pixels share materials."""


ALL = Parts()


def solve_material(stack: Stack, lights: Lights, camera: Camera, mask: np.ndarray, device: str, timings: Timings,
                   field: NearField | None = None, parts: Parts = ALL) -> Solution:
    """Solve every pixel of the mask: normal, diffuse albedo, F0 and roughness.

    Args:
        stack: the images.
        lights: of the stack, padded.
        camera: of the capture.
        mask: [rows, cols] bool.
        device: where.
        timings: told of every stage.
        field: where the lights are, and the point of each pixel, where some light is near; then light that the object throws on
            itself is not taken off.
        parts: what is left out.
    """
    factors, view = grey_factors(lights, GREY_WEIGHTS), view_directions(camera)
    result = Solution.empty(stack.pixel_count)
    result.specular = np.zeros((3, stack.pixel_count), np.float16)
    result.roughness = np.zeros(stack.pixel_count, np.float16)
    timings.stage("start", stack.shape[2])
    _start(result, stack, lights, factors, mask.reshape(-1), device, timings, field)
    solvable = np.flatnonzero(result.status == Status.OK)
    timings.stage("shape", 1)
    shape = Diffuse()
    if len(solvable):
        few, samples = _spread(stack, lights, factors, view, solvable, device, field)
        shape, tried = choose_diffuse(samples, result.normal[:, few].T)
        result.facts = {"diffuse_roughness": None if shape.rough < 0 else shape.rough, "diffuse_slope": shape.slope,
                        "shapes_tried": len(tried)}

    def batches(stage: str) -> Iterator[Batch]:
        timings.stage(stage, len(solvable))
        done = 0
        for batch in pixel_batches(stack, lights, factors, view, solvable, device, lobes=MIXTURE + GEOMETRY, field=field):
            yield batch
            done += len(batch.where)
            timings.advance(done)

    bounce = parts.bounce and field is None
    for where, samples in batches("search"):
        normal = search_normals(samples, result.normal[:, where].T, shape=shape).normal
        result.normal[:, where] = normal.T
        if bounce:
            first = fit_tinted(samples, normal, shape=shape)
            result.albedo[:, where], result.roughness[where] = first.diffuse_albedo.T, first.roughness
    timings.stage("surface", 100)
    solved = (result.status == Status.OK).reshape(mask.shape)
    surface = integrate(camera, result.normal, solved, device, lambda part: timings.advance(round(100 * part)))
    inside = wp.array(solved.astype(np.uint8), dtype=wp.uint8, device=device)
    projection, arriving = projection_of(camera), None
    if bounce and surface is not None:
        arriving = arriving_light(stack, lights, camera, projection, result.normal, surface.height, solved, device)

    def clean(where: np.ndarray, samples: Samples) -> None:
        """Take out of the readings what the height tells."""
        assert surface is not None  # there are pixels
        if parts.shadows:
            exclude_shadows(samples, where, surface.height, inside, projection, None if field is None else field.places)
        if arriving is not None:
            corners, shares = arriving.at(*np.divmod(where, camera.width))
            albedo = np.minimum(result.albedo[:, where].T.astype(np.float32), LARGEST_ALBEDO)
            subtract_bounce(samples, arriving.light, corners, shares, albedo, channel_weights(lights, GREY_WEIGHTS))

    materials = None
    if parts.sharing and len(solvable):
        few, samples = _spread(stack, lights, factors, view, solvable, device, field)
        clean(few, samples)
        materials = choose_materials(samples, result.normal[:, few].T, shape=shape)
        result.facts["shared_materials"] = [{"specular": material[:3].tolist(), "roughness": float(material[3])}
                                            for material in materials.round(4).astype(float)]
    for where, samples in batches("normals"):
        clean(where, samples)
        found = solve_svbrdf(samples, result.normal[:, where].T, shape=shape, shared=materials,
                             roughness=result.roughness[where].astype(np.float32) if bounce else None)
        result.normal[:, where] = found.normal.T
        result.albedo[:, where] = found.diffuse_albedo.T
        result.specular[:, where] = found.specular.T
        result.roughness[where] = found.roughness
        result.confidence[where] = found.confidence
        result.residual[where] = found.residual
    return result


def projection_of(camera: Camera) -> Projection:
    """How camera-frame points fall on the picture; lens distortion, which moves shadows by its own few pixels, is left out."""
    centre = camera.principal_px or (camera.width / 2, camera.height / 2)
    if camera.projection == "perspective":
        assert camera.focal_px is not None
        return Projection(True, wp.vec2(*camera.focal_px), wp.vec2(*centre))
    per_unit = 1.0 / (camera.pixel_size_m or 1.0)
    return Projection(False, wp.vec2(per_unit, per_unit), wp.vec2(*centre))


def _start(result: Solution, stack: Stack, lights: Lights, factors: np.ndarray, inside: np.ndarray, device: str,
           timings: Timings, field: NearField | None) -> None:
    """Normals and status to begin from: those of `robust`."""
    for start, stop in stack.bands((READING_BYTES if field is None else NEAR_BYTES) * stack.shape[1]):
        here = slice(start, min(stop, stack.pixel_count))
        if inside[here].any():
            band = packs.upload(stack.band(start, stop), stack.saturated(start, stop), device=device)
            readings = grey_readings(band, factors)
            near = None if field is None else see_near(band, readings, field.at(np.arange(start, stop)))
            result.place(here, inside[here], solve_robust(band, readings, lights.direction, near))
        timings.advance(stop)


def _spread(stack: Stack, lights: Lights, factors: np.ndarray, view: View, solvable: np.ndarray, device: str,
            field: NearField | None) -> tuple[np.ndarray, Samples]:
    """Some pixels at even steps through the object, from which is chosen what all share: positions and readings."""
    chosen = solvable[evenly(len(solvable), SPREAD_PIXELS)]
    band = packs.upload(*stack.pick(chosen), device=device)
    return chosen, gather(band, np.arange(len(chosen)), view(chosen), lights, factors, stack.light_count,
                          None if field is None else field.at(chosen))
