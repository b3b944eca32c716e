"""Import of the frames of a depth camera beside a colour camera (Kinect and its like): depth images, intrinsics and poses, as scans.

A pixel at an edge of depth shows a mixture of both sides, which is no surface, and is left out. The noise of structured light grows with
the square of the distance (Khoshelham and Elberink, "Accuracy and resolution of Kinect depth data", Sensors 12, 2012, equation 10: σ =
.0014 z² for z in metres). What the calibration of the depth leaves is alike over parts of the image, and larger."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy.ndimage import maximum_filter, minimum_filter

from service.requests.imports.scans import ScansImport
from service.scans.points.rigid import nearest_rigid
from stage.capture.camera import Camera
from stage.errors import ManifestError
from stage.formats.images import read_recorded
from stage.formats.ply import POINTS_FILE, PointCloud, write_ply
from stage.importers.depth_frames import INTRINSICS, FrameLayout, read_frames, read_intrinsics
from stage.results.depth_maps import DEPTH_FILE, DepthMaps
from stage.sets.scan_set import MOST_OFF_ROTATION, ScanEntry
from stage.transforms import OPENCV_FROM_CAMERA, ROTATION_ROUNDING, off_rotation, rigid_fault

NONE = (0, 65535)
"""Values of a depth image that are no depth."""
EDGE, EDGE_RADIUS_PX = 0.03, 3
"""Depths in a neighbourhood that differ by this part are an edge: a plane seen at 77° by a camera of 60° is none."""
SIGMA_PER_M2 = 0.005
"""σ of a depth over the square of the depth, 1/m: between .004 and .006 the pairs of six real frames of a room are explained."""


def write_frames(request: ScansImport, layout: FrameLayout, check: Callable[[int], object]
                 ) -> tuple[list[ScanEntry], list[tuple[str, str]]]:
    """Write each frame as a folder with a depth.exr, and with the colours as points.ply, and return the scans and what was understood.
    `check`: is called with the number of frames before any is written.
    Raises ManifestError: intrinsics are missing, or a pose or an image is wrong; names the file."""
    folder, unit_m = request.source, layout.unit_m if request.depth_unit_m is None else request.depth_unit_m
    if request.intrinsics_px is not None:
        fx, fy, cx, cy = request.intrinsics_px
    elif (matrix := read_intrinsics(folder)) is not None:
        fx, fy, cx, cy = matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]
    else:
        raise ManifestError(f"{folder}: has depth images and no {INTRINSICS}: give --intrinsics FX,FY,CX,CY, of the first Kinect and its "
                            "like about 525,525,319.5,239.5")
    frames = read_frames(folder, layout, request.poses)[:: request.every]
    check(len(frames))
    paths = (path for frame in frames for path in (frame.depth, frame.colour) if path is not None)
    if missing := next((path for path in paths if not path.is_file()), None):
        raise ManifestError(f"{missing}: is not there, and the lists of {folder} name it")
    names = [frame.name for frame in frames]
    if twice := next((name for at, name in enumerate(names) if name in names[:at]), None):
        raise ManifestError(f"{folder}: two depth images are named {twice}: name them apart")
    entries, turned, dropped, total = [], 0.0, 0, 0
    for frame in frames:
        recorded = read_recorded(frame.depth)
        if recorded.dtype != np.uint16:
            raise ManifestError(f"{frame.depth}: is no image of 16 bits, as depths are")
        depth = recorded[..., 0].astype(np.float64)
        there = ~np.isin(depth, NONE) & np.isfinite(depth)
        depth = np.where(there, depth * unit_m, 0)
        kept = there & ~_edges(depth, there)
        dropped, total = dropped + int((there & ~kept).sum()), total + int(there.sum())
        if not kept.any():
            raise ManifestError(f"{frame.depth}: holds no depth")
        camera = Camera(projection="perspective", resolution=(depth.shape[1], depth.shape[0]), focal_px=(fx, fy),
                        principal_px=(cx + 0.5, cy + 0.5))
        maps = DepthMaps(camera=camera, mask=kept, depth=np.where(kept, depth, 0).astype(np.float32),
                         sigma=np.where(kept, SIGMA_PER_M2 * depth**2, 0).astype(np.float32))
        maps.write(request.folder / frame.name / DEPTH_FILE)
        if (colours := _colours(frame.colour, kept)) is not None:
            write_ply(PointCloud(camera.points(-maps.depth)[kept].astype(np.float32), colours), request.folder / frame.name / POINTS_FILE)
        pose = frame.pose
        if pose is not None:
            if (fault := rigid_fault(pose, MOST_OFF_ROTATION)) is not None:
                raise ManifestError(f"{frame.depth}: its pose {fault}")
            turned = max(turned, off_rotation(pose))
            pose = nearest_rigid(pose)
            pose[:3, :3] = pose[:3, :3] @ OPENCV_FROM_CAMERA
        entries.append(ScanEntry.model_validate({"name": frame.name, "path": frame.name,
                                                 **({} if pose is None else {"scan_to_world": pose.tolist()})}))
    placed = sum(entry.scan_to_world is not None for entry in entries)
    facts = [("layout", layout.value),
             ("scans", f"{len(entries)} depth images of {depth.shape[1]}x{depth.shape[0]} pixels, {unit_m:g} m a unit"),
             ("camera", f"focal lengths {fx:g}, {fy:g} and middle {cx:g}, {cy:g} pixels"),
             ("edges", f"{dropped / total:.1%} of the depths lie at edges, where they mix two surfaces, and are left out"),
             ("sigma", f"{SIGMA_PER_M2:g} z², z in metres, of a Kinect"),
             ("poses", f"{placed} of {len(entries)} have one")]
    if turned > ROTATION_ROUNDING:
        facts.append(("turned", f"rotations were off orthonormal by up to {turned:.1g}: the nearest are taken"))
    return entries, facts


def _edges(depth: np.ndarray, there: np.ndarray) -> np.ndarray:
    """Return the pixels [h, w] near which depths jump."""
    size = 2 * EDGE_RADIUS_PX + 1
    farthest = maximum_filter(np.where(there, depth, 0), size)
    nearest = minimum_filter(np.where(there, depth, np.inf), size)
    return farthest - nearest > EDGE * depth


def _colours(path: Path | None, kept: np.ndarray) -> np.ndarray | None:
    """Return the colours [n, 3] uint8 of pixels from a colour image of the same size as the depths, or None."""
    if path is None:
        return None
    recorded = read_recorded(path)
    return recorded[kept] if recorded.shape[:2] == kept.shape and recorded.dtype == np.uint8 else None
