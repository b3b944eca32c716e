"""Whether the pixels that one axis of patterns lights contradict the calibration of the projector.

One coordinate for each pixel leaves no residual, so that any calibration gives some surface. But what the projector lights lies in its
image, also along the other axis; and a plane comes out as a plane under the right pose: under another it bends, unless both devices look
the same way.
"""

from typing import NamedTuple

import numpy as np

from kernels.device import to_numpy
from kernels.status import OK, SOLVED, Status
from kernels.structured.decoded import Decoded
from kernels.structured.pattern_frames import NoiseModel
from kernels.structured.triangulate import ProjectorModel, triangulate
from service.depth.patterns.decoders import AxisDecoder
from service.depth.patterns.pattern_checks import ENOUGH, Sample, decode_sample, turned_about
from stage.transforms import OPENCV_FROM_CAMERA

OUTSIDE = 0.05
"""Share of the decoded pixels, beside others like them, without a point that the projector can light, from which on it is doubted: no
pixel of simulated walls, rooms and objects was such a one where the projector was declared rightly."""
INSIDE = 0.01
"""Largest such share under another pose that is named."""
IN_A_PLANE, TIMES = 0.3, 1.6
"""Share of the pixels in one plane under another pose, from which on it is named if it is so many times the share as declared: under right
ones it was 1.35 times at most, of rooms, bent walls, boxes and balls."""
PLANE_PX, PLANE_SIGMAS = 0.15, 2.5
"""Distance from a plane within which a pixel lies in it, in projector pixels for what lenses leave, and in deviations that are added."""
MOST_POINTS, TRIALS = 1500, 150
"""Number of pixels of which a plane is sought, and of planes through three of them: with a third of them in it, five in 150 are."""


class Fit(NamedTuple):
    """How a projector fits the decoded pixels of a sample, as shares of these."""

    outside: float
    plane: float
    """Those of the plane that most of them lie in."""


def check_pose(sample: Sample, decoders: tuple[AxisDecoder | None, AxisDecoder | None], model: ProjectorModel, noise: NoiseModel,
               device: str) -> str | None:
    """Return a sentence if the places of one axis contradict the projector; None if they do not, or with both axes."""
    if None not in decoders:
        return None
    decoded = [None if decoder is None else decode_sample(sample, decoder, noise, device) for decoder in decoders]
    declared = _fit(sample, decoded, model, device)
    if declared is None:
        return None
    own = OPENCV_FROM_CAMERA @ model.projector_from_camera  # on the axes of a manifest's poses
    inverse = model._replace(projector_from_camera=OPENCV_FROM_CAMERA @ np.column_stack([own[:, :3].T, -own[:, :3].T @ own[:, 3]]))
    for words, view, shown in (
            ("it is the inverse: give the pose of the projector in the camera frame", inverse, decoded),
            ("the projected image is mirrored, or dark and bright are exchanged in all bits: check the projector's settings and the images",
             model, turned_about(decoded, model, device))):
        other = _fit(sample, shown, view, device)
        if other is not None and other.outside <= INSIDE and other.plane >= max(IN_A_PLANE, TIMES * declared.plane):
            return (f"projector.camera_from_projector: as declared, {100 * declared.plane:.0f} % of the lit pixels lie in one plane, and "
                    f"{100 * other.plane:.0f} % do if {words}")
    if declared.outside >= OUTSIDE:
        return (f"projector.camera_from_projector: as declared, {100 * declared.outside:.0f} % of the pixels that the projector lights see "
                "nothing that lies in its image: give its pose in the camera frame (not the inverse; metres, y up, z backward), and check "
                "its focal_px, principal_px and resolution, and the patterns of the frames")
    return None


def _fit(sample: Sample, decoded: list[Decoded | None], model: ProjectorModel, device: str) -> Fit | None:
    """Return how a projector fits what is decoded; None if too few pixels are."""
    found = triangulate(sample.x.ravel(), sample.y.ravel(), decoded[0], decoded[1], model, near_m=0.0, far_m=np.inf, max_residual_px=np.inf,
                        device=device)
    axis = next(each for each in decoded if each is not None)
    depth, deviation, status, read, spread = (to_numpy(array)[:sample.mask.size].reshape(sample.mask.shape) for array in (
        found.depth, found.sigma, found.status, axis.status, axis.sigma))
    lit = np.isin(read, SOLVED) & sample.mask
    if lit.sum() < ENOUGH:
        return None
    beyond = lit & (status == Status.OUT_OF_RANGE)
    beside = beyond[:, 1:-1] & beyond[:, 2:] & beyond[:, :-2]  # far away noise takes as many beyond infinity as leave no parallax
    outside = max(0.0, float((beside.sum() - (lit & (status == Status.ILL_POSED)).sum()) / lit.sum()))
    some = np.flatnonzero((lit & (status == OK)).ravel())
    some = some[:: max(1, len(some) // MOST_POINTS)]
    if len(some) < ENOUGH:
        return Fit(outside, 0.0)
    z, sigma, own = (plane.ravel()[some].astype(np.float64) for plane in (depth, deviation, spread))
    of_px = sigma / z**2 / np.maximum(own, 1e-3)  # inverse depth for a projector pixel
    near = PLANE_PX * of_px + PLANE_SIGMAS * sigma / z**2
    ray = np.stack([sample.x.ravel()[some], sample.y.ravel()[some], np.ones(len(some))], axis=1)
    three = np.random.default_rng(0).integers(0, len(some), (TRIALS, 3))
    planes = np.linalg.solve(ray[three] + 1e-9 * np.eye(3), (1 / z)[three][..., None])[..., 0]
    inside = np.abs(planes @ ray.T - 1 / z) < near
    best = inside[inside.sum(axis=1).argmax()]
    plane = np.linalg.lstsq(ray[best] / near[best, None], 1 / (z * near)[best], rcond=None)[0]
    count = max(best.sum(), (np.abs(ray @ plane - 1 / z) < near).sum())
    return Fit(outside, float(count / len(some) * (lit & (status == OK)).sum() / lit.sum()))
