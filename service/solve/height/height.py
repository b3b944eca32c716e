"""Normals → height: of the solved pixels, and from these of the whole mask."""

from dataclasses import replace

import numpy as np
import warp as wp
from scipy import ndimage

from kernels.surface.integrate import Integration, IntegrationOptions, integrate_normals
from kernels.surface.shadows import Projection
from service.requests.solve import Method
from service.solve.base.solution import SolveInput
from stage.capture.camera import Camera

OPTIONS = IntegrationOptions(discontinuities=True)
"""The surface may break where slopes around a pixel contradict each other: objects hide parts of themselves."""
QUICK = replace(OPTIONS, tolerance=1e-4)
"""Those of a surface from which shadows and bounced light are told, and nothing else: its slopes are right to a ten-thousandth."""
GUESSED_SIGMA = 30.0
"""Standard error, in degrees, of a normal above which its slope is a guess."""
GUESSED_PART = 0.1
"""Part of the surface that may rest on such normals before it is said."""
LEAST_METAL = 0.3
"""F0 in its brightest channel from which on a material is a metal."""
LEAST_THIN = 20
"""Pixels on thin parts of the mask from which they are said: a mask that was drawn by hand has some at its rim."""
RINGS = 8
"""Unsolved pixels this near to solved ones are filled from their neighbours; farther ones, which few solves have, by blocks."""


def integrate(given: SolveInput, normal: np.ndarray, solved: np.ndarray, *, sigma: np.ndarray | None = None,
              specular: np.ndarray | None = None, cuts: tuple[np.ndarray, np.ndarray] | None = None, options: IntegrationOptions = OPTIONS,
              stage: str = "height") -> Integration | None:
    """Integrate the normals of the solved pixels.

    Args:
        normal: [3, pixels] float32.
        sigma: [pixels] standard errors of the normals, degrees; None: all are sure.
        specular: [3, pixels] F0: the surface may break where a metal meets a dielectric; None: not known.
        cuts: edges to the right, and edges down, that the surface breaks along besides, [rows, cols] bool each.
        options: of the integration.
        stage: what the progress calls this work.

    Returns:
        The height on the device, or None when no pixel is solved.
    """
    if not solved.any():
        return None
    given.timings.stage(stage, 100)
    camera = given.camera
    return integrate_normals(normal.reshape(3, *solved.shape), solved, *camera.plane_views(),
                             perspective=camera.projection == "perspective", mean_z=mean_height(camera),
                             sigma=None if sigma is None else sigma.reshape(solved.shape), cuts=cuts,
                             kind=None if specular is None else _metals(specular.reshape(3, *solved.shape)), options=options,
                             device=given.device, progress=given.timings.advance_percent)


def _metals(specular: np.ndarray) -> np.ndarray:
    """Return where F0 [3, rows, cols] is that of a metal at most of the pixels around, [rows, cols] bool."""
    return np.asarray(ndimage.uniform_filter((specular.max(axis=0) > LEAST_METAL).astype(np.float32), 3) > 0.5)


def guessed_part(sigma: np.ndarray, estimated: np.ndarray) -> float:
    """Return the part of the surface whose height rests on normals that are hardly known, by their standard errors in degrees [pixels]; 0
    without a surface."""
    return float((sigma.reshape(estimated.shape)[estimated] > GUESSED_SIGMA).mean()) if estimated.any() else 0.0


def height_warnings(guessed: float, method: Method, mask: np.ndarray) -> list[str]:
    """Return a sentence for wires and hair, parts of a mask under three pixels wide, and one where much of the height is a guess, by the
    part that guessed_part returns."""
    found = []
    if mask.any() and not mask.all():
        wide = ndimage.binary_dilation(ndimage.binary_opening(mask, np.ones((3, 3))), np.ones((5, 5)))  # with its corners and rims
        thin = int((mask & ~wide).sum())
        if thin >= LEAST_THIN:
            found.append(f"height: {thin} pixels lie on parts of the object under three pixels wide, such as wires: their normals and "
                         "heights are mixed with what lies behind them; photograph them larger")
    if guessed <= GUESSED_PART:
        return found
    cure = "try --method svbrdf, which knows highlights and metals" if method in (Method.LAMBERT, Method.ROBUST) else "try more lights"
    return [*found, f"height: {guessed:.0%} of the surface rests on normals with a standard error above {GUESSED_SIGMA:g} degrees, so its "
            f"shape is a guess there: {cure}"]


def mean_height(camera: Camera) -> float:
    """Return the camera-frame z that the mean of the surface is given.

    It is the capture's, else 0, or for a perspective camera without a scale the distance at which one pixel spans one unit.
    """
    if camera.projection == "perspective" and camera.surface_z_m is None:
        assert camera.focal_px is not None
        return -sum(camera.focal_px) / 2
    return camera.surface_z_m or 0.0


def projection_of(camera: Camera) -> Projection:
    """Return how camera-frame points fall on the image; lens distortion, which moves shadows by its own few pixels, is left out."""
    centre = camera.principal_point
    if camera.projection == "perspective":
        assert camera.focal_px is not None
        return Projection(True, wp.vec2(*camera.focal_px), wp.vec2(*centre))
    per_unit = 1.0 / (camera.pixel_size_m or 1.0)
    return Projection(False, wp.vec2(per_unit, per_unit), wp.vec2(*centre))


def whole_surface(height: np.ndarray, solved: np.ndarray, mask: np.ndarray, *, mean_z: float, perspective: bool) -> np.ndarray:
    """Return a height for every pixel of the mask, so that lights find a surface wherever they shine.

    Args:
        height: [rows, cols] float32, camera-frame z of the solved pixels; each connected part has an unknown constant of its own.
        solved: [rows, cols] bool, one pixel or more, inside the mask.
        mask: [rows, cols] bool.
        mean_z: the mean over the mask of what is returned.
        perspective: whether the constants are factors of the depth; else they are added.

    Returns:
        [rows, cols] float32, finite everywhere. In each connected part of the mask the largest solved part stays, and smaller
        ones are moved to where it would reach them; unsolved pixels have the mean height of solved ones around them.
    """
    out = height.astype(np.float64)
    part, whole = _labels(solved), _labels(mask)[solved]
    size = np.bincount(part[solved])
    home = np.zeros(len(size), dtype=np.int64)  # the part of the mask that each solved part lies in
    home[part[solved]] = whole
    order = np.lexsort((size, home))  # the largest of each home last
    largest = np.zeros(len(size), dtype=bool)
    largest[order[np.append(home[order][1:] != home[order][:-1], True)]] = True
    if not largest.all():
        kept = solved & largest[np.where(solved, part, 0)]
        reached = _fill(out, kept, mask)
        there, here = (np.bincount(part[solved], weights=z[solved]) / size for z in (reached, out))
        there[largest] = here[largest]
        moved = out * (there / here)[part] if perspective else out + (there - here)[part]
        out = np.where(solved, moved, out)
    out = _fill(out, solved, mask)
    mean = out[mask].mean()
    return (out * (mean_z / mean) if perspective else out + (mean_z - mean)).astype(np.float32)


def _labels(mask: np.ndarray) -> np.ndarray:
    """Return [rows, cols] the number of the connected part of each pixel; 0 outside too."""
    return np.maximum(ndimage.label(mask)[0].astype(np.int64) - 1, 0)


def _fill(height: np.ndarray, known: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Return the known heights, and a height for all other pixels."""
    out, known = np.where(known, height, 0), known.copy()
    for _ in range(RINGS):
        total, count = _around(out), _around(known.astype(np.float64))
        ring = mask & ~known & (count > 0)
        if not ring.any():
            break
        out[ring] = total[ring] / count[ring]
        known |= ring
    return _fill_by_blocks(out, known.astype(np.float64))


def _around(values: np.ndarray) -> np.ndarray:
    """Return the sum of the four neighbours of each pixel."""
    framed = np.pad(values, 1)
    return framed[:-2, 1:-1] + framed[2:, 1:-1] + framed[1:-1, :-2] + framed[1:-1, 2:]


def _fill_by_blocks(total: np.ndarray, count: np.ndarray) -> np.ndarray:
    """Return the mean, total / count, where a height is known; elsewhere that of the smallest block of 2, 4, 8, … pixels that holds one."""
    if (count > 0).all():
        return total / count
    rows, cols = total.shape
    even = ((0, rows % 2), (0, cols % 2))
    coarse = _fill_by_blocks(*(np.pad(a, even).reshape(-(-rows // 2), 2, -(-cols // 2), 2).sum(axis=(1, 3)) for a in (total, count)))
    finer = coarse.repeat(2, axis=0).repeat(2, axis=1)[:rows, :cols]
    return np.where(count > 0, total / np.maximum(count, 1), finer)
