"""The scans of a fusion: each is prepared when it is first asked for, and then lies in files that are mapped into memory."""

import json
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

from kernels.fusion.resample import STEEPEST, STEP_SIGMAS, resample
from kernels.fusion.views import RangeImage
from service.errors import RequestError
from service.scans.fusion.fused_surface import centre_of
from service.scans.fusion.misplaced import Sample, sample_of
from service.scans.fusion.range_images import SQUARE_VOXELS, PreparedScan, focal_of, prepare_scan, with_layers
from service.scans.points.rigid import nearest_rigid
from service.scans.points.scan import Scan
from service.scans.read import FLOAT_STEP, read_scan
from stage.capture.camera import Camera
from stage.formats.npy import packed, unpacked
from stage.sets.scan_set import ScanSet

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
T = TypeVar("T")

LEAST_PIXELS = 100
"""Fewest pixels in cells that a scan must have."""


class ScanSummary(NamedTuple):
    """Facts of a scan that a fusion needs of every scan."""

    name: str
    names: tuple[str, ...]  # its layers
    pitch: float  # metres between neighbouring pixels on the surface, median
    noise: float  # metres, standard deviation of the depth, median
    centre: np.ndarray  # [3] metres, world
    photometric: bool
    normal_sigma: float  # radians, as of `PreparedScan`
    camera: Camera
    camera_from_world: np.ndarray  # [4, 4]
    square_px: int  # as of `PreparedScan`
    sample: Sample

    def packed(self) -> bytes:
        """Return the summary as bytes."""
        known = {"name": self.name, "names": self.names, "photometric": self.photometric, "camera": self.camera.model_dump(mode="json"),
                 "square_px": self.square_px}
        return packed({"known": np.frombuffer(json.dumps(known).encode(), dtype=np.uint8), "pitch": self.pitch, "noise": self.noise,
                       "normal_sigma": self.normal_sigma, "centre": self.centre, "camera_from_world": self.camera_from_world,
                       **self.sample._asdict()})

    @staticmethod
    def unpacked(content: bytes) -> "ScanSummary":
        """Return the summary of `packed`."""
        found = unpacked(content)
        known = json.loads(found["known"].tobytes())
        return ScanSummary(known["name"], tuple(known["names"]), float(found["pitch"]), float(found["noise"]), found["centre"],
                           known["photometric"], float(found["normal_sigma"]), Camera.model_validate(known["camera"]),
                           found["camera_from_world"], known["square_px"], Sample(found["points"], found["normals"], found["variance"]))

    def outline(self) -> PreparedScan:
        """Return the scan without what it measured, to ask whether it can see a place."""
        nothing: Any = np.broadcast_to(np.float32(0), (self.camera.height, self.camera.width))
        image = RangeImage(nothing, nothing, nothing, nothing, nothing, self.camera_from_world, focal_of(self.camera),
                           self.camera.principal_point, orthographic=self.camera.projection == "orthographic")
        return PreparedScan(self.name, image, self.camera, self.names, nothing, nothing, self.photometric)


class PreparedScans:
    """The scans of a set."""

    def __init__(self, file: Path, scan_set: ScanSet, folder: Path, voxel_m: float | None, *, device: str) -> None:
        """Create the scans, of which none is read yet; an existing folder takes their arrays.
        `voxel_m`: metres, to which pixels that are far smaller are joined; None: they stay. `device`: where sets of points are made
        range images."""
        self._file, self._scan_set, self._folder, self._voxel_m, self._device = file, scan_set, folder, voxel_m, device
        self._prepared: dict[int, PreparedScan] = {}
        self._complete: dict[int, PreparedScan] = {}
        self._one_set = threading.Lock()  # sets of points are made range images one by one, which bounds the memory
        self._locks = [threading.Lock() for _ in scan_set.scans]

    def __len__(self) -> int:
        """Return the number of scans."""
        return len(self._scan_set.scans)

    def poses(self) -> list[np.ndarray] | None:
        """Return world from scan [4, 4] of every scan as the scan set gives it, or None if it does not give all."""
        given = [entry.scan_to_world for entry in self._scan_set.scans]
        return None if None in given else [nearest_rigid(np.array(pose, dtype=np.float64)) for pose in given]

    def prepared(self, number: int) -> PreparedScan:
        """Return a scan with the layers that it has."""
        with self._locks[number]:
            if number not in self._prepared:
                self._prepared[number] = self._read(number)
            return self._prepared[number]

    def of(self, number: int, use: Callable[[PreparedScan], T]) -> T:
        """Return what `use` makes of a scan with the layers that it has, of which nothing stays in memory then."""
        scan = self.prepared(number)
        try:
            return use(scan)
        finally:
            scan.release()

    def with_layers(self, number: int, names: tuple[str, ...]) -> PreparedScan:
        """Return a scan with these layers, of which those that it lacks are 0."""
        prepared = self.prepared(number)
        with self._locks[number]:
            if number not in self._complete:
                self._complete[number] = with_layers(prepared, names, self._folder / str(number))
            return self._complete[number]

    def summary(self, number: int) -> ScanSummary:
        """Return the summary of a scan."""
        return self.of(number, lambda scan: _summary(scan, number))

    def _read(self, number: int) -> PreparedScan:
        folder = self._folder / str(number)
        folder.mkdir()
        scan = read_scan(self._file, self._scan_set, number)
        where = f"{self._file}: scans[{number}] ({scan.name})"
        if scan.pose is None:
            raise RequestError(f"{where}: scan_to_world is missing: run relit register first, and fuse the scan-set.json that it writes")
        if scan.camera is None:
            if self._scan_set.scans[number].viewpoint_m is None:
                raise RequestError(f"{where}: viewpoint_m is missing: {scan.path.name} is a set of points, and only lines of sight say "
                                   "what is empty; give the place of the scanner in the frame of the file, metres")
            with self._one_set:
                scan = as_range_image(scan, where, self._voxel_m, device=self._device)
            prepared = prepare_scan(scan, folder)
        else:
            prepared = prepare_scan(scan, folder, self._voxel_m)
        if np.count_nonzero(prepared.image.cell) < LEAST_PIXELS:
            raise RequestError(f"{where}: has {np.count_nonzero(prepared.image.cell)} pixels whose neighbours show the same surface: its "
                               "pixels are too far apart or too noisy to be fused")
        return prepared


def _summary(scan: PreparedScan, number: int) -> ScanSummary:
    cell = np.asarray(scan.image.cell)
    pitch = scan.image.pixel_m(float(np.median(np.asarray(scan.image.depth)[cell])))
    return ScanSummary(scan.name, scan.names, pitch, float(np.median(np.asarray(scan.image.sigma)[cell])), centre_of(scan),
                       scan.photometric, scan.normal_sigma, scan.camera, scan.image.camera_from_world, scan.square_px,
                       sample_of(scan, number))


# Sets of points as the range images that fusion takes: what the scanner saw from the place that `viewpoint_m` of the scan set names.
#
# The image looks from there at the middle of the points and has about as many pixels as there are points. Between the viewpoint and each
# point nothing was in the way. A set that was not seen from there, as the scans of all sides in one file, has points behind others.

def as_range_image(scan: Scan, where: str, voxel_m: float | None = None, *, device: str) -> Scan:
    """Return a set of points as a range image from its viewpoint, in the frame of a camera that looks at the middle of the points.
    `scan`: a set of points with a pose, whose `origin` is where the scanner stood. `voxel_m`: metres, to which points that are far
    closer together are joined; None: they stay."""
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
                   colours=None if scan.colours is None else scan.colours[of_point],
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
