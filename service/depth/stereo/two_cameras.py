"""Depth from two cameras under the patterns of one projector, which nobody has calibrated: both decode, and the cameras are triangulated.

The second camera takes the place that a calibrated projector has elsewhere: the pixel in which it sees the same column and row is the
coordinate that is intersected with the line of sight of the first.
"""

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import warp as wp
from scipy.spatial import cKDTree

from kernels.device import to_numpy
from kernels.packs import padded_count
from kernels.status import ESTIMATED, SOLVED, Status
from kernels.structured.decoded import Decoded
from kernels.structured.triangulate import triangulate
from service.depth.base.epipolar import Contradiction, contradiction, settled, view_facts
from service.depth.base.solution import DepthSolution, statistics
from service.depth.base.triangulation_check import check_perspective, check_projector
from service.depth.patterns.agreement import ADVICE, conclude, doubt_pixels
from service.depth.patterns.coordinates import DecodedSolution
from service.depth.patterns.patterns import projector_model, solve_patterns
from service.depth.stereo.camera_doubts import LEAST_PX, TURNED, as_projector, sentence, widened
from service.errors import RequestError
from service.reporting.progress import Timings
from service.requests.depth import DepthRequest
from stage.capture.camera import Camera
from stage.capture.capture import Capture
from stage.capture.manifest import FILE_NAME
from stage.capture.projector import Projector, UncalibratedProjector
from stage.errors import ManifestError

POSES = {Status.OUT_OF_RANGE: "the places that both cameras see and the poses contradict each other: check camera.world_from_camera of "
                              "both captures (metres, y up, z towards the camera) and camera.focal_px"}
"""What is said of two cameras in place of a projector."""
REACH = 2
"""The window of the planes is this many pixels to every side: stripes as wide as a few pixels have slopes there too."""
STEP_TIMES = 4.0
"""A neighbour counts where its column and row differ by no more than this many times the usual difference for each pixel between."""
LEAST_NEIGHBOURS = 8
FARTHEST_PX = 0.8
"""The most pixels from the middle of the nearest pixel of the second camera to the place that it sees."""
FARTHEST_CELLS = 4.0
"""The farthest that the nearest pixel of the second camera is looked for in the projector, in distances of such pixels there."""
SMALLEST_SLOPE = 0.02
"""The least determinant of the slopes, relative to its median: below it the place slides along the image."""


class CodedImage(NamedTuple):
    """The decoded columns and rows of one camera."""

    values: np.ndarray  # [2, rows, cols] float32, projector pixels
    sigma: np.ndarray  # [2, rows, cols] float32
    solved: np.ndarray  # [rows, cols] bool


class Places(NamedTuple):
    """The places at which the second camera sees the pixels of the first."""

    place: np.ndarray  # [n, 2] continuous image coordinates of the second camera
    sigma: np.ndarray  # [n, 2] pixels
    found: np.ndarray  # [n] bool


def solve_two_cameras(capture: Capture, beside: Path, mask: np.ndarray, request: DepthRequest, device: str,
                      timings: Timings) -> DepthSolution:
    """Decode both captures and intersect the lines of sight of their cameras, at the pixels of the first.
    `beside`: folder of the capture of the second camera, under the same patterns of the same projector."""
    other = Capture.open(beside, request.pixels._replace(crop=None))
    for each in (capture, other):
        check_perspective(each)
    given = _second_camera(capture, other)
    plain = request.model_copy(update={"near_m": None, "far_m": None, "max_sigma": None, "normals": False, "refine_projector": False})
    images, warnings = [], list[str]()
    for each, inside in ((capture, mask), (other, other.mask())):
        found = solve_patterns(_uncalibrated(each), inside, plain, device, timings)
        assert isinstance(found, DecodedSolution)
        warnings += [f"{each.folder / FILE_NAME}: {words}" for words in found.warnings[1:]]  # the first: that depth is not asked for
        columns, rows = found.coordinates.columns, found.coordinates.rows
        if columns is None or rows is None:
            raise RequestError(f"--beside: {each.folder} has a code of one axis alone: two cameras need columns and rows to find the "
                               "place that both see")
        images.append((found, CodedImage(np.stack([columns.coordinate, rows.coordinate]), np.stack([columns.sigma, rows.sigma]),
                                         np.isin(found.status, SOLVED) & inside)))
    (own, first), (_, second) = images
    timings.stage("match", 1)
    wanted = first.solved
    asked, asked_sigma = (np.stack([plane[wanted] for plane in two], axis=1) for two in (first.values, first.sigma))
    places = find_places(asked.astype(np.float64), asked_sigma, second)
    planes = np.zeros((4, *mask.shape), np.float32)
    planes[:, wanted] = np.concatenate([places.place, places.sigma], axis=1).T
    status = own.status.copy()
    status[wanted] = np.where(places.found, own.status[wanted], int(Status.OCCLUDED))

    def measure(view: Projector, before: Contradiction | None) -> tuple[tuple[DepthSolution, np.ndarray], Contradiction | None]:
        solution, residual = _intersected(own, planes, status, mask, capture.camera, view, request, device)
        judged = solution.solved
        seen, sigma = (np.stack([plane[judged] for plane in two], axis=1) for two in (planes[:2], planes[2:]))
        return (solution, residual), contradiction(view, capture.camera.points(-solution.depth)[judged], seen, sigma, least_px=LEAST_PX,
                                                   alike=float(2 * REACH + 1) ** 2, free=TURNED, before=before)

    view, (solution, residual), contradicted = settled(given, measure, refine=request.refine_projector)
    told = {"capture": str(beside), "matched": int(places.found.sum()), "residual_px": statistics(residual[solution.solved])}
    solution.facts = {**own.facts, "beside": told}
    solution.facts.pop("decoded_only", None)
    if contradicted is not None:
        assert solution.sigma is not None
        solution.sigma = widened(solution.depth, solution.sigma, capture.camera, contradicted, given)
        warnings.append(sentence("--beside: camera", contradicted, given, capture.camera))
        told["contradiction_px"] = float(f"{contradicted.size_px:.3g}")
        if view is not given:
            pose = capture.camera.pose @ np.array(view.camera_from_projector)
            told["refined"] = view_facts(view, "world_from_camera", pose.tolist())
        if not (contradicted.plausible or contradicted.aside) and request.least_confidence is None:
            solution.status[solution.solved] = Status.UNSURE
    conclude(solution, doubt_pixels(solution, residual, capture.camera, view, device), mask, request, warnings, ADVICE | POSES)
    return solution


def _intersected(own: DecodedSolution, planes: np.ndarray, status: np.ndarray, mask: np.ndarray, camera: Camera, seen_by: Projector,
                 request: DepthRequest, device: str) -> tuple[DepthSolution, np.ndarray]:
    """Return where the lines of sight of both cameras meet, and by how many pixels of the second they miss each other, [rows, cols].

    Args:
        own: what the first camera has decoded.
        planes: columns and rows of the places in the second camera, and their standard deviations, [4, rows, cols] pixels.
        status: [rows, cols] of the places.
        seen_by: the second camera.
    """
    x, y = camera.plane_coordinates()
    u, v = (_decoded(planes[axis], planes[axis + 2], own.coordinates.amplitude, status, device) for axis in (0, 1))
    found = triangulate(x.ravel().astype(np.float32), y.ravel().astype(np.float32), u, v, projector_model(seen_by),
                        near_m=request.near_m or 0.0, far_m=request.far_m or np.inf, max_residual_px=request.max_residual_px, device=device)
    depth, sigma, residual, code = (to_numpy(array)[:mask.size].reshape(mask.shape) for array in found)
    status = np.where(status == Status.OCCLUDED, status, code).astype(np.uint8)
    kept = np.isin(status, ESTIMATED) & (depth > 0)
    status[~mask] = int(Status.UNSOLVED)
    columns, rows = own.coordinates.columns, own.coordinates.rows
    assert columns is not None and rows is not None  # `solve_two_cameras` has checked it
    return DepthSolution(
        method=f"{own.method}, two cameras", depth=np.where(kept, depth, 0).astype(np.float32), status=status,
        sigma=np.where(kept, sigma, 0).astype(np.float32), projector_u=columns.coordinate, projector_v=rows.coordinate,
        sigma_u=columns.sigma, sigma_v=rows.sigma, amplitude=own.coordinates.amplitude), residual


def _second_camera(capture: Capture, other: Capture) -> Projector:
    """Return the second camera as the projector of the first, checked as one."""
    camera = other.camera
    if camera.world_from_camera is None:
        raise ManifestError(f"{other.folder / FILE_NAME}: camera.world_from_camera: is missing: two cameras are triangulated by their "
                            "poses in one world (that of the first camera, where its capture gives none)")
    pose = np.linalg.inv(capture.camera.pose) @ np.array(camera.world_from_camera)
    seen_by = as_projector(camera, pose)
    try:
        return check_projector(replace(capture, manifest=capture.manifest.model_copy(update={"projector": seen_by})))
    except ManifestError as error:
        raise ManifestError(str(error).replace(f"{capture.folder / FILE_NAME}: projector.camera_from_projector",
                                               f"{other.folder / FILE_NAME}: camera.world_from_camera").replace(
                                                   "the projector", "the second camera")) from error


def _uncalibrated(capture: Capture) -> Capture:
    """Return a capture whose projector is not calibrated, so that its patterns are decoded alone."""
    projector = capture.manifest.projector
    if not isinstance(projector, Projector):
        return capture
    plain = UncalibratedProjector(**{name: getattr(projector, name) for name in UncalibratedProjector.model_fields})
    return replace(capture, manifest=capture.manifest.model_copy(update={"projector": plain}))


def _decoded(coordinate: np.ndarray, sigma: np.ndarray, amplitude: np.ndarray, status: np.ndarray, device: str) -> Decoded:
    """Return coordinates on the device, padded to whole packs."""
    padding = padded_count(coordinate.size, device) - coordinate.size
    return Decoded(*(wp.array(np.pad(plane.ravel().astype(kind), (0, padding)), dtype=dtype, device=device) for plane, kind, dtype in (
        (coordinate, np.float32, wp.float32), (sigma, np.float32, wp.float32), (amplitude, np.float32, wp.float32),
        (status, np.uint8, wp.uint8))))


# Finds where a second camera sees the places of a projector that the first one sees, from the coordinates that both have decoded.
#
# Each pixel of the second camera has decoded a column and a row; in the neighbourhood of a pixel they are nearly linear in the image. A
# plane is fitted to each there, and the place at which both have the wanted values is where that pixel and the slopes of the planes say.

def find_places(asked: np.ndarray, asked_sigma: np.ndarray, other: CodedImage) -> Places:
    """Find the places of the projector in the image of a second camera.
    `asked, asked_sigma`: [n, 2] columns and rows of the first camera, projector pixels, and their standard deviations. `other`: what the
    second camera has decoded."""
    planes = _planes(other)
    if planes is None:
        return Places(np.zeros(asked.shape), np.zeros(asked.shape), np.zeros(len(asked), dtype=bool))
    place, value, slope, variance = planes
    spacing = float(np.sqrt(np.median(np.abs(np.linalg.det(slope)))))
    far, nearest = cKDTree(value).query(asked, distance_upper_bound=FARTHEST_CELLS * max(spacing, 1e-6))
    nearest = np.minimum(nearest, len(value) - 1)  # of none that is near enough
    inverse = np.linalg.inv(slope[nearest])
    wanted = asked - value[nearest]
    moved = np.einsum("nij,nj->ni", inverse, wanted)
    spread = variance[nearest] + asked_sigma**2
    sigma = np.sqrt(np.einsum("nij,nj->ni", inverse**2, spread))
    found = np.isfinite(far) & (np.abs(moved).max(axis=1) <= FARTHEST_PX)
    return Places(np.where(found[:, None], place[nearest] + moved, 0), np.where(found[:, None], sigma, 0), found)


def _planes(other: CodedImage) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray] | None:
    """Return [m, 2] image coordinates, [m, 2] columns and rows, [m, 2, 2] their slopes and [m, 2] variances of the pixels with planes."""
    solved = other.solved
    rows, cols = solved.shape
    if min(rows, cols) <= 2 * REACH or not solved.any():
        return None
    values = other.values.astype(np.float64)
    across = np.abs(np.diff(values, axis=2)), solved[:, 1:] & solved[:, :-1]
    down = np.abs(np.diff(values, axis=1)), solved[1:] & solved[:-1]
    usual = np.array([max((float(np.median(step[number][both])) for step, both in (across, down) if both.any()), default=0.0)
                      for number in range(2)])
    usual = np.maximum(usual, 1e-3) + np.array([np.median(sigma[solved]) for sigma in other.sigma])
    inner = (slice(REACH, rows - REACH), slice(REACH, cols - REACH))
    middle = values[:, inner[0], inner[1]]
    gram = np.zeros((*middle.shape[1:], 3, 3))
    right = np.zeros((2, *middle.shape[1:], 3))
    squares, number = np.zeros(middle.shape), np.zeros(middle.shape[1:])
    for dy in range(-REACH, REACH + 1):
        for dx in range(-REACH, REACH + 1):
            part = (slice(REACH + dy, rows - REACH + dy), slice(REACH + dx, cols - REACH + dx))
            off = values[:, part[0], part[1]] - middle
            limit = STEP_TIMES * usual * max(abs(dx), abs(dy), 1)
            counts = (solved[part] & (np.abs(off) <= limit[:, None, None]).all(axis=0)).astype(np.float64)
            base = np.array([1.0, dx, dy])
            gram += counts[..., None, None] * np.outer(base, base)
            right += (counts * off)[..., None] * base
            squares += counts * off**2
            number += counts
    good = solved[inner] & (number >= LEAST_NEIGHBOURS) & (np.linalg.det(gram) > 1.0)
    if not good.any():
        return None
    inverse = np.linalg.inv(gram[good])
    fitted = np.einsum("nij,knj->kni", inverse, right[:, good])
    left = np.maximum(squares[:, good] - (fitted * right[:, good]).sum(axis=2), 0) / np.maximum(number[good] - 3, 1)
    sigmas = np.stack([sigma[inner][good] for sigma in other.sigma]).astype(np.float64)
    # the decoder's error or that of the plane, whichever is larger, over the pixels of the window
    variance = np.maximum(sigmas**2, left) * inverse[:, 0, 0]
    slope = np.moveaxis(fitted[:, :, 1:], 0, 1)
    determinant = np.abs(np.linalg.det(slope))
    kept = determinant > SMALLEST_SLOPE * np.median(determinant)
    if not kept.any() or np.median(determinant) <= 0:
        return None
    y, x = np.nonzero(good)
    place = np.stack([x + REACH + 0.5, y + REACH + 0.5], axis=1)
    value = (middle[:, good] + fitted[:, :, 0]).T
    return place[kept], value[kept], slope[kept], variance.T[kept]
