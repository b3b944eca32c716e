"""Depth from two cameras under the patterns of one projector, which nobody has calibrated: both decode, and the cameras are triangulated.

The second camera takes the place that a calibrated projector has elsewhere: the pixel in which it sees the same column and row is the
coordinate that is intersected with the line of sight of the first.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import warp as wp

from kernels.packs import padded_count
from kernels.status import ESTIMATED, SOLVED, Status
from kernels.structured.decoded import Decoded
from kernels.structured.triangulate import triangulate
from service.depth.base.solution import DepthSolution, statistics
from service.depth.base.triangulation_check import check_perspective, check_projector
from service.depth.patterns.agreement import conclude, doubt_pixels
from service.depth.patterns.coordinates import DecodedSolution
from service.depth.patterns.patterns import projector_model, solve_patterns
from service.depth.stereo.same_place import CodedImage, find_places
from service.errors import RequestError
from service.reporting.progress import Timings
from service.requests.depth import DepthRequest
from stage.capture.capture import Capture
from stage.capture.manifest import FILE_NAME
from stage.capture.projector import Projector, UncalibratedProjector
from stage.errors import ManifestError


def solve_two_cameras(capture: Capture, beside: Path, mask: np.ndarray, request: DepthRequest, device: str,
                      timings: Timings) -> DepthSolution:
    """Decode both captures and intersect the lines of sight of their cameras, at the pixels of the first.

    Args:
        beside: folder of the capture of the second camera, under the same patterns of the same projector.
    """
    other = Capture.open(beside, request.pixels._replace(crop=None))
    for each in (capture, other):
        check_perspective(each)
    seen_by = _as_projector(capture, other)
    plain = request.model_copy(update={"near_m": None, "far_m": None, "max_sigma": None, "normals": False})
    images = []
    for each, inside in ((capture, mask), (other, other.mask())):
        found = solve_patterns(_uncalibrated(each), inside, plain, device, timings)
        assert isinstance(found, DecodedSolution)
        columns, rows = found.coordinates.columns, found.coordinates.rows
        if columns is None or rows is None:
            raise RequestError(f"--beside: {each.folder} has a code of one axis alone: two cameras need columns and rows to find the "
                               "place that both see")
        images.append((found, CodedImage(columns.coordinate, rows.coordinate, columns.sigma, rows.sigma,
                                         np.isin(found.status, SOLVED) & inside)))
    (own, first), (_, second) = images
    timings.stage("match", 1)
    wanted = first.solved
    places = find_places(first.column[wanted].astype(np.float64), first.row[wanted].astype(np.float64), first.sigma_column[wanted],
                         first.sigma_row[wanted], second)
    planes = [np.zeros(mask.shape, np.float32) for _ in range(4)]
    for plane, values in zip(planes, places[:4], strict=True):
        plane[wanted] = values
    status = own.status.copy()
    status[wanted] = np.where(places.found, own.status[wanted], int(Status.OCCLUDED))
    x, y = capture.camera.plane_coordinates()
    u, v = (_decoded(planes[axis], planes[axis + 2], own.coordinates.amplitude, status, device) for axis in (0, 1))
    found_depth = triangulate(x.ravel().astype(np.float32), y.ravel().astype(np.float32), u, v, projector_model(seen_by),
                              near_m=request.near_m or 0.0, far_m=request.far_m or np.inf, max_residual_px=request.max_residual_px,
                              device=device)
    depth, sigma, residual, code = (array.numpy()[:mask.size].reshape(mask.shape) for array in found_depth)
    status = np.where(status == Status.OCCLUDED, status, code).astype(np.uint8)
    kept = np.isin(status, ESTIMATED) & (depth > 0)
    status[~mask] = int(Status.UNSOLVED)
    solution = DepthSolution(method=f"{own.method}, two cameras", depth=np.where(kept, depth, 0).astype(np.float32), status=status,
                             sigma=np.where(kept, sigma, 0).astype(np.float32), projector_u=first.column, projector_v=first.row,
                             sigma_u=first.sigma_column, sigma_v=first.sigma_row, amplitude=own.coordinates.amplitude)
    solution.facts = {**own.facts, "beside": {"capture": str(beside), "matched": int(places.found.sum()),
                                              "residual_px": statistics(residual[np.isin(status, SOLVED)])}}
    solution.facts.pop("decoded_only", None)
    conclude(solution, doubt_pixels(solution, residual, capture.camera, seen_by, device), mask, request, [])
    return solution


def _as_projector(capture: Capture, other: Capture) -> Projector:
    """Return the second camera as the projector of the first, checked as one."""
    camera = other.camera
    if camera.world_from_camera is None:
        raise ManifestError(f"{other.folder / FILE_NAME}: camera.world_from_camera: is missing: two cameras are triangulated by their "
                            "poses in one world (that of the first camera, where its capture gives none)")
    world = np.eye(4) if capture.camera.world_from_camera is None else np.array(capture.camera.world_from_camera)
    pose = np.linalg.inv(world) @ np.array(camera.world_from_camera)
    seen_by = Projector.model_validate({
        "resolution": camera.resolution, "focal_px": camera.focal_px, "principal_px": camera.principal_px, "distortion": camera.distortion,
        "camera_from_projector": pose.tolist()})
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
