"""The scans of a fusion: each is prepared when it is first asked for, and then lies in files that are mapped into memory."""

import json
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

from kernels.fusion.views import RangeImage
from service.errors import RequestError
from service.scans.fusion.fused_surface import centre_of
from service.scans.fusion.misplaced import Sample, sample_of
from service.scans.fusion.point_sets import as_range_image
from service.scans.fusion.range_images import PreparedScan, focal_of, prepare_scan, with_layers
from service.scans.read import read_scan
from stage.capture.camera import Camera
from stage.formats.npy import packed, unpacked
from stage.sets.scan_set import ScanSet

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

        Args:
            voxel_m: metres, to which pixels that are far smaller are joined; None: they stay.
            device: where sets of points are made range images.
        """
        self._file, self._scan_set, self._folder, self._voxel_m, self._device = file, scan_set, folder, voxel_m, device
        self._prepared: dict[int, PreparedScan] = {}
        self._complete: dict[int, PreparedScan] = {}
        self._one_set = threading.Lock()  # sets of points are made range images one by one, which bounds the memory
        self._locks = [threading.Lock() for _ in scan_set.scans]

    def __len__(self) -> int:
        """Return the number of scans."""
        return len(self._scan_set.scans)

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
        scan = read_scan(self._file, self._scan_set, number, estimate_normals=False)
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
