"""Diffuse and specular normals, albedo and, behind polarisers, F₀ and roughness from spherical gradient frames, band by band.

Occlusion makes the response to a gradient longer, interreflection shorter. Where one goes over into the other both are present, and the
length is that of an open surface: such a pixel is as doubtful as those around it.
"""

from typing import Any

import numpy as np
from scipy import ndimage

from kernels.device import to_numpy
from kernels.packs import Band
from kernels.photometric.gradient.gradient import diffuse_normals
from kernels.photometric.gradient.highlight import fit_highlights, specular_normals
from kernels.photometric.gradient.moments import Moments, fit_moments
from kernels.photometric.gradient.separation import separate_by_colour, separate_polarised
from kernels.photometric.model.misfit import LARGEST_ERROR
from kernels.status import Status
from service.sharing.sharing import Results
from service.solve.base.batches import each_span, view_directions
from service.solve.base.solution import Solution, SolveInput, half
from service.solve.methods.gradient_doubts import gradient_doubts
from stage.capture.camera import Camera
from stage.capture.gradients import GradientFrames
from stage.colour.colour import GREY_WEIGHTS
from stage.stack.stack import Stack

BYTES_PER_PIXEL = 400
"""Responses of up to three kinds of frames, separation, view and results, beside the stack's band."""
CROSSED_GAIN = 2.0
"""A crossed analyser passes half of the diffuse light, which has lost its polarisation (Malus)."""
MIN_DIFFUSE = 0.01
"""Ratio of diffuse to specular light below which a pixel is metal: what is left of the diffuse is noise, and its direction too."""
METAL_SIGMA = 4.0
"""Standard error, in degrees, of a normal that only a highlight tells: no second reading checks the lobe."""


def solve_gradients(given: SolveInput, frames: GradientFrames) -> Solution:
    """Solve every pixel of the mask from gradient frames."""
    stack, inside = given.stack, given.mask.reshape(-1)
    given.timings.stage("normals", stack.shape[2])
    pixels = stack.pixel_count
    view = view_vectors(given.camera, stack.shape[2])
    result = Solution.empty(pixels)
    if not frames.polarised or frames.parallel is not None:
        result.specular_normal = np.zeros((3, pixels), np.float32)
    if frames.parallel is not None:
        result.specular, result.roughness = np.zeros((3, pixels), np.float16), np.zeros(pixels, np.float16)
    bent = np.zeros(pixels, np.float32)
    length, separated, metal = np.zeros(pixels, np.float32), np.zeros(pixels, bool), np.zeros(pixels, bool)
    gain = CROSSED_GAIN if frames.polarised else 1.0

    def solve(start: int, stop: int, device: str) -> None:
        here = slice(start, min(stop, pixels))
        kept = inside[here]
        band = given.images[device].band(start, stop)
        toward = view if view.shape[1] == 1 else view[:, start:stop]
        diffuse = _moments(band, frames.diffuse, stack)
        if not frames.polarised:
            parts = separate_by_colour(diffuse, toward, pixel_count=band.pixel_count, device=device)
            diffuse = parts.diffuse
            normal = specular_normals(parts, GREY_WEIGHTS, toward, gain=gain, pixel_count=band.pixel_count, device=device)
            _store(result.specular_normal, here, kept, normal)
        elif frames.parallel is not None:
            parallel = _moments(band, frames.parallel, stack)
            parts = separate_polarised(diffuse, parallel, GREY_WEIGHTS, leak=frames.leak, pixel_count=band.pixel_count, device=device)
            diffuse = parts.diffuse
            highlight = fit_highlights(parts, GREY_WEIGHTS, toward, gain=gain, pixel_count=band.pixel_count, device=device)
            _store(result.specular_normal, here, kept, highlight.normal)
            _store(result.specular, here, kept, highlight.f0)
            _store(result.roughness, here, kept, highlight.roughness)
        fit = diffuse_normals(diffuse, GREY_WEIGHTS, gain=gain, pixel_count=band.pixel_count, device=device)
        _store(result.normal, here, kept, fit.normal)
        _store(result.albedo, here, kept, fit.albedo)
        _store(result.sigma, here, kept, fit.sigma)
        _store(result.residual, here, kept, diffuse.residual)
        _store(result.status, here, kept, fit.status)
        _store(length, here, kept, fit.length)
        _store(bent, here, kept, fit.bent)
        if frames.parallel is not None:
            metal[here] = _take_highlight(result, here, to_numpy(parts.specular)[:3, : len(kept)])
            result.residual[here] = np.where(metal[here], to_numpy(parallel.residual)[: len(kept)], result.residual[here])
        separated[here] = kept & (to_numpy(diffuse.tilt)[: len(kept)] == 0)

    found = (result.normal, result.albedo, result.sigma, result.residual, result.status, result.specular_normal, result.specular,
             result.roughness, bent, length, separated, metal)
    each_span(given, BYTES_PER_PIXEL, solve, Results([array for array in found if array is not None]))
    neighbours = neighbours_doubt(bent.reshape(given.mask.shape), given.mask).reshape(-1)
    estimated = (result.status == Status.OK) & ~metal
    doubted = np.sqrt(np.maximum(result.standard_error() ** 2 - bent**2 + neighbours**2, 0))
    result.sigma[estimated] = np.minimum(doubted[estimated], LARGEST_ERROR)
    result.facts = _facts(frames, result, length, separated, metal)
    doubts = gradient_doubts(stack, inside, frames)
    result.warnings += doubts
    if doubts:
        result.sigma[metal] = LARGEST_ERROR  # nothing else checks highlights
    if result.specular_normal is not None and not result.specular_normal.any():
        result.specular_normal = None  # a layer that holds nothing is absent
    return result


def view_vectors(camera: Camera, padded: int) -> np.ndarray:
    """Return unit vectors from the surface to the camera: [3, padded] float32, 0 in the padding, or [3, 1] when all are the same."""
    if camera.projection == "orthographic":
        return np.array([[0.0], [0.0], [1.0]], dtype=np.float32)
    toward = view_directions(camera)(np.arange(camera.width * camera.height)).T
    return np.pad(toward, ((0, 0), (0, padded - toward.shape[1])))


def _facts(frames: GradientFrames, result: Solution, length: np.ndarray, separated: np.ndarray,
           metal: np.ndarray) -> dict[str, Any]:
    solved = result.status == Status.OK
    how = "colour" if not frames.polarised else "polarisation" if frames.parallel is not None else "crossed polariser"
    facts: dict[str, Any] = {"separation": how, "pixels_separated": int((solved & separated).sum()),
                             "pixels_taken_as_diffuse": int((solved & ~separated).sum()), "frames_unused": list(frames.unused)}
    if result.specular_normal is not None:
        facts["pixels_with_specular_normal"] = int((solved & result.specular_normal.any(axis=0)).sum())
        facts["pixels_by_highlight_alone"] = int(metal.sum())
    solved &= ~metal
    if solved.any():  # the length of the response vector, (3/2)|M|/M0, is one on a convex Lambertian surface
        middle, low = np.percentile(length[solved], [50, 5])
        facts["response_length"] = {"median": round(float(middle), 5), "p5": round(float(low), 5)}
    return facts


def _take_highlight(result: Solution, here: slice, specular: np.ndarray) -> np.ndarray:
    """Take the normal of the highlight where there is no diffuse light, as on metal, and return [n] bool where that is."""
    assert result.specular_normal is not None
    normal = result.specular_normal[:, here]
    metal = normal.any(axis=0) & (result.albedo[:, here].astype(np.float32).sum(axis=0) <= MIN_DIFFUSE * specular.sum(axis=0))
    result.normal[:, here][:, metal] = normal[:, metal]
    result.sigma[here][metal] = METAL_SIGMA
    result.status[here][metal] = int(Status.OK)
    return metal


def _store(target: np.ndarray | None, here: slice, kept: np.ndarray, found: Any) -> None:
    """Store the result of a band; 0 outside the mask, which as a status is UNSOLVED."""
    assert target is not None
    values = to_numpy(found)[..., : len(kept)]
    target[..., here] = np.where(kept, half(values) if target.dtype == np.float16 else values, 0)


def _moments(band: Band, rows: np.ndarray, stack: Stack) -> Moments:
    padded = np.zeros((band.frame_count, 4))
    padded[: len(rows)] = rows
    return fit_moments(band, padded, stack.scale, GREY_WEIGHTS)


PART = 16
"""Neighbours are the pixels within one part in this many of the object's longer side: dents and grooves are wider."""
LEAST = 3
"""Least number of pixels of a 3 × 3 neighbourhood that are this doubtful: a groove one pixel wide has three, noise seldom."""


def neighbours_doubt(doubt: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """Return the largest doubt in the neighbourhood of each pixel that LEAST pixels beside each other share, [rows, cols] float32.

    It is `doubt` at least, which is not negative, and 0 outside the mask.
    """
    if not inside.any():
        return np.zeros(doubt.shape, np.float32)
    rows, cols = np.nonzero(inside)
    reach = max(1, (int(max(np.ptp(rows), np.ptp(cols))) + 1) // PART)
    spread = ndimage.rank_filter(doubt.astype(np.float32), -LEAST, size=3, mode="constant")
    spread = ndimage.maximum_filter(spread, 2 * reach + 1, mode="constant")
    return np.where(inside, np.maximum(spread, doubt), 0).astype(np.float32)
