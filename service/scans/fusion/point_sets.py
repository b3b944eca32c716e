"""Sets of points as the range images that fusion takes: what the scanner saw from the place that `viewpoint_m` of the scan set names.

The image looks from there at the middle of the points and has about as many pixels as there are points. Between the viewpoint and each
point nothing was in the way. A set that was not seen from there, as the scans of all sides in one file, has points behind others.
"""

from dataclasses import replace

import numpy as np

from kernels.fusion.resample import STEEPEST, STEP_SIGMAS, resample
from service.errors import RequestError
from service.scans.fusion.range_images import SQUARE_VOXELS
from service.scans.points.scan import Scan
from service.scans.read import FLOAT_STEP
from stage.capture.camera import Camera

MOST_OFF_AXIS_DEGREES = 55.0
"""Largest angle of a line of sight beside the middle of a scan. The pixels of a flat image see too little beyond."""
ROUNDS = 300
"""Steps of the search for the middle of the lines of sight, which then is right to some tenths of a degree."""
POINTS_IN_SQUARE = 4.0
"""Mean number of points of an occupied square of two by two pixels: one for each pixel."""
THINNEST = 1e-6
"""Least width of the image for its length that their distance is told from: points in a line are no surface."""
MOST_PIXELS_A_POINT = 8
"""Most pixels of the image for each point. More are a scan of separate parts, or points that belong to none."""
MOST_AMISS = 0.1
"""Part of the points that may lie before or behind what their pixel shows, as some do at the edges of parts before others; and that may
have a normal that points away from the viewpoint, as at grazing angles."""


def as_range_image(scan: Scan, where: str, voxel_m: float | None = None, *, device: str) -> Scan:
    """Return a set of points as a range image from its viewpoint, in the frame of a camera that looks at the middle of the points.

    Args:
        scan: a set of points with a pose, whose `origin` is where the scanner stood.
        voxel_m: metres, to which points that are far closer together are joined; None: they stay.
    """
    away = scan.points.astype(np.float64) - scan.origin
    range_m = np.linalg.norm(away, axis=1)
    direction = away / np.maximum(range_m, np.finfo(np.float64).tiny)[:, None]
    axis = _middle(direction)
    cosine = direction @ axis
    sigma = np.maximum(scan.sigma, FLOAT_STEP * range_m) * cosine
    del direction, range_m
    if (widest := float(np.degrees(np.arccos(np.clip(cosine.min(), -1, 1))))) > MOST_OFF_AXIS_DEGREES:
        raise RequestError(f"{where}: has points {widest:.0f}° beside the middle of what is seen from viewpoint_m; at most "
                           f"{MOST_OFF_AXIS_DEGREES:g}° can be: give another viewpoint_m, or the parts as scans of their own")
    if scan.normals is not None:
        along = np.einsum("ij,ij->i", scan.normals, away)
        if (turned := _part(along[along != 0] > 0)) > MOST_AMISS:
            raise RequestError(f"{where}: {turned:.0%} of its normals point away from viewpoint_m: they cannot have been seen from there. "
                               "Give the right viewpoint_m, or each scan in a file of its own")
    camera_from_scan = _looking(axis)
    x, y, z = camera_from_scan @ away.T
    depth, across, up = -z, -x / z, -y / z
    del away, cosine, x, y, z
    pitch = _spacing(np.stack([across, up], axis=1))
    if voxel_m is not None:
        pitch = max(pitch, SQUARE_VOXELS * voxel_m / float(np.median(depth)))
    left, top = across.min() - pitch, up.max() + pitch
    cols, rows = (int(np.ceil(extent / pitch)) + 1 for extent in (across.max() - left, top - up.min()))
    if rows * cols > MOST_PIXELS_A_POINT * len(scan.points):
        raise RequestError(f"{where}: its {len(scan.points)} points are spread over {cols} x {rows} pixels as seen from viewpoint_m: take "
                           "out those that lie apart, or give the parts as scans of their own")
    camera = Camera(projection="perspective", resolution=(cols, rows), focal_px=(1 / pitch, 1 / pitch),
                    principal_px=(-left / pitch, top / pitch))
    place = np.stack([(across - left) / pitch, (top - up) / pitch], axis=1)
    del across, up
    image = resample(place, depth, sigma, (rows, cols), 1 / pitch, device=device)
    behind = _off_image(place, depth, sigma, image.depth, pitch)
    if behind > MOST_AMISS:
        raise RequestError(f"{where}: {behind:.0%} of its points lie before or behind others as seen from viewpoint_m: they are no scan "
                           "from there. Give the right viewpoint_m, or each scan in a file of its own")
    pixels = np.flatnonzero(image.nearest >= 0)
    if len(pixels) == 0:
        raise RequestError(f"{where}: its {len(scan.points)} points show no surface as seen from viewpoint_m: they are too few, "
                           "or lie in lines that are too far apart")
    points = camera.points_at(pixels, -image.depth.reshape(-1)[pixels])
    of_point = image.nearest.reshape(-1)[pixels]
    stretch = np.linalg.norm(points, axis=1) / -points[:, 2]
    scan_from_camera = np.eye(4)
    scan_from_camera[:3, :3], scan_from_camera[:3, 3] = camera_from_scan.T, scan.origin
    assert scan.pose is not None
    return replace(scan, points=points, sigma=(image.sigma.reshape(-1)[pixels] * stretch).astype(np.float32), normals=None,
                   normals_source="unknown", colours=None if scan.colours is None else scan.colours[of_point],
                   confidence=None if scan.confidence is None else scan.confidence[of_point], origin=np.zeros(3), camera=camera,
                   pixels=pixels, pose=scan.pose @ scan_from_camera, pose_covariance=None, targets=())  # these are of the frame before


def _middle(direction: np.ndarray) -> np.ndarray:
    """Return the unit vector whose largest angle with any of [n, 3] unit vectors is about the least.

    Source: Badoiu and Clarkson, "Smaller core-sets for balls", SODA 2003 (the middle of the smallest ball around points).
    """
    ways = np.array([way for way in np.ndindex(3, 3, 3) if way != (1, 1, 1)]) - 1
    farthest = direction[[int((direction @ way).argmax()) for way in ways]]
    middle = farthest.mean(axis=0)
    for number in range(ROUNDS):
        middle += (farthest[((farthest - middle) ** 2).sum(axis=1).argmax()] - middle) / (number + 2)
    return np.asarray(middle / max(float(np.linalg.norm(middle)), np.finfo(np.float64).tiny))


def _spacing(places: np.ndarray) -> float:
    """Return the distance of neighbouring points of [n, 2], so that where there are any there is one in each square of it."""
    extent = np.ptp(places, axis=0)
    least = max(THINNEST * float(extent.max()), np.finfo(np.float64).eps)
    side = 2 * float(np.sqrt(np.prod(np.maximum(extent, least)) / len(places)))
    for _ in range(6):
        column, row = np.floor((places - places.min(axis=0)) / side).astype(np.int64).T
        squares = np.sort(row * (column.max() + 1) + column)
        held = len(places) / (1 + np.count_nonzero(np.diff(squares)))
        side *= float(np.clip(np.sqrt(POINTS_IN_SQUARE / held), 0.5, 2.0))
    return side / 2


def _looking(axis: np.ndarray) -> np.ndarray:
    """Return the rotation into the frame of a camera that looks along a unit vector, with the y of the scan, or else its x, upwards."""
    up = np.eye(3)[1 if abs(axis[1]) < abs(axis[0]) + abs(axis[2]) else 0]
    right = np.cross(axis, up)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(right, axis), -axis])


def _off_image(place: np.ndarray, depth: np.ndarray, sigma: np.ndarray, image: np.ndarray, pitch: float) -> float:
    """Return the part of the points that lie before or behind what their pixel shows, of those whose pixel shows anything."""
    col, row = np.floor(place).astype(np.int64).T
    shown = image[row, col]
    known = shown > 0
    off = np.abs(shown - depth) > STEEPEST * pitch * np.minimum(shown, depth) + STEP_SIGMAS * sigma
    return _part(off[known])


def _part(true: np.ndarray) -> float:
    """Return the part of [n] bool that is True, 0 of none."""
    return float(true.mean()) if true.size else 0.0
