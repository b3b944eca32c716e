"""Rectification: two cameras turned about their centres until a point lies on the same row of both images, and the frames of both so.

Both images are resampled onto the plane z = 1 of one rotated frame, whose x axis runs from the reference camera to the other: whatever
the place of the other camera, the reference camera is then the left one, and a point at depth Z of that frame has the disparity
D = f B / Z, with the baseline B and the common focal length f.

Source: Fusiello, Trucco and Verri, "A compact algorithm for rectification of stereo pairs", Machine Vision and Applications 12, 2000.

Convention: axes of OpenCV within the rectified frame, x along the baseline, y down, z forward.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from math import ceil, floor
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.ndimage import correlate1d

from service.depth.base.triangulation_check import check_baseline
from stage.capture.camera import Camera, OtherCamera
from stage.capture.capture import Capture
from stage.capture.manifest import Frame
from stage.colour.colour import GREY_WEIGHTS, linearise
from stage.errors import ManifestError
from stage.motion.resample import bicubic, touched
from stage.stack.planes import scratch_arrays
from stage.transforms import OPENCV_FROM_CAMERA

LEAST_ASIDE = 0.35
"""Sine of the least angle between the baseline and the direction in which both cameras look: an image cannot be rectified whose epipole
lies in it."""
MOST_GROWTH = 3.0
"""The most pixels of a rectified image, relative to the camera's: cameras that need more look in directions that are too different."""
BORDER = 64
"""Points along each side of an image from which the extent of its rectified image is taken."""
BAND_PIXELS = 1 << 20
"""Pixels that are resampled at one time."""
BINOMIAL = (0.25, 0.5, 0.25)
"""The filter by which both images are smoothed along rows and columns."""


class Grid(NamedTuple):
    """The pixels of one rectified image: column c and row r have their centre at x = (left + c) / f, y = (top + r) / f."""

    left: float
    top: float
    width: int
    height: int


class Rectification(NamedTuple):
    """The common frame of two cameras and the rectified image of each."""

    reference: Camera
    other: Camera
    rectified_from_reference: np.ndarray  # [3, 3] float64, from the camera frame
    rectified_from_other: np.ndarray  # [3, 3] float64, from the frame of the other camera
    focal_px: float
    baseline_m: float
    left: Grid
    right: Grid

    @property
    def offset_px(self) -> float:
        """The disparity D of two pixels that have the same column in their images; both images have the same rows."""
        return self.left.left - self.right.left

    def rows_of(self, image: np.ndarray, *, other: bool) -> tuple[np.ndarray, np.ndarray]:
        """Resample an image [rows, cols] float32 of one of the two cameras.
        Returns the rectified image, [rows, cols] float32, and [rows, cols] bool, False where the camera saw nothing."""
        grid, camera = (self.right, self.other) if other else (self.left, self.reference)
        turn = self.rectified_from_other if other else self.rectified_from_reference
        values = np.zeros((grid.height, grid.width), np.float32)
        seen = np.zeros(values.shape, bool)
        unread = ~np.isfinite(image)
        clean = np.where(unread, 0, image).astype(np.float32)
        step = max(1, BAND_PIXELS // grid.width)
        for first in range(0, grid.height, step):
            last = min(first + step, grid.height)
            x, y = np.meshgrid((grid.left + np.arange(grid.width)) / self.focal_px, (grid.top + np.arange(first, last)) / self.focal_px)
            towards = np.stack([x, y, np.ones_like(x)], axis=-1) @ turn  # its inverse, the transpose, on each row
            ahead = towards[..., 2] < -1e-6
            points = np.where(ahead[..., None], towards, (0.0, 0.0, -1.0))
            points = points / -points[..., 2:]
            u, v = camera.image_coordinates(points)
            at_x, at_y = u - 0.5, v - 0.5
            inside = ahead & (at_x > -0.5) & (at_y > -0.5) & (at_x < camera.width - 0.5) & (at_y < camera.height - 0.5)
            col, row = (np.clip(at, 0, size - 1).astype(np.float32) for at, size in ((at_x, camera.width), (at_y, camera.height)))
            values[first:last] = bicubic(clean, col, row)
            seen[first:last] = inside & ~touched(unread, col, row)
        return values, seen

    def positions(self, rows: slice) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return where pixels of the reference camera lie in its rectified image.
        Returns column and row in the left image, whole at the centres of its pixels; and the depth of the rectified frame at depth 1 of
        the reference camera. Each [rows, cols] float64."""
        u, v = np.meshgrid(np.arange(self.reference.width) + 0.5, np.arange(rows.start, rows.stop) + 0.5)
        x, y = self.reference.plane_at(u, v)
        towards = np.stack([x, y, -np.ones_like(x)], axis=-1) @ self.rectified_from_reference.T
        z = np.maximum(towards[..., 2], 1e-9)
        return towards[..., 0] / z * self.focal_px - self.left.left, towards[..., 1] / z * self.focal_px - self.left.top, towards[..., 2]


def pose_of(other: OtherCamera, *, where: str) -> np.ndarray:
    """Return where another camera stands in the frame of the camera, [4, 4] metres.
    `where`: the file and the field of the other camera, for messages. Raises ManifestError: it is not calibrated."""
    if other.camera_from_other is None:
        raise ManifestError(f"{where}: {other.name} has no focal_px and no camera_from_other: depth needs its lens and pose; "
                            "relit calibrate stereo measures them")
    return np.array(other.camera_from_other, dtype=np.float64)


def rectify(reference: Camera, other: OtherCamera, *, where: str) -> Rectification:
    """Return how the images of two cameras are rectified.
    `where`: the file and the field of the other camera, for messages. Raises ManifestError: the other camera is not calibrated; the
    cameras stand at one place or implausibly far apart, one behind the other, or look in different directions."""
    pose = pose_of(other, where=where)
    centre = OPENCV_FROM_CAMERA @ pose[:3, 3]
    baseline = float(np.linalg.norm(centre))
    check_baseline(baseline, f"{where}.camera_from_other: the camera", "the first")
    own = OPENCV_FROM_CAMERA @ pose[:3, :3] @ OPENCV_FROM_CAMERA  # the axes of the other camera in those of the reference
    if own[2, 2] <= 0.2:
        angle = np.degrees(np.arccos(np.clip(own[2, 2], -1, 1)))
        raise ManifestError(f"{where}.camera_from_other: the cameras look in directions {angle:.0f} degrees apart: both look along -z, "
                            "+y is up")
    x_axis = centre / baseline
    forward = own[:, 2] + (0.0, 0.0, 1.0)
    forward /= np.linalg.norm(forward)
    aside = forward - (forward @ x_axis) * x_axis
    if np.linalg.norm(aside) < LEAST_ASIDE:
        raise ManifestError(f"{where}.camera_from_other: one camera stands before the other: stereo needs cameras beside or above one "
                            "another")
    z_axis = aside / np.linalg.norm(aside)
    turn = np.stack([x_axis, np.cross(z_axis, x_axis), z_axis])
    from_reference = turn @ OPENCV_FROM_CAMERA
    from_other = turn @ own @ OPENCV_FROM_CAMERA
    second = other.camera
    assert reference.focal_px is not None and second.focal_px is not None  # both are perspective
    focal = float(np.sqrt(reference.focal_px[0] * reference.focal_px[1]))
    boxes = [_extent(camera, matrix, focal, where) for camera, matrix in ((reference, from_reference), (second, from_other))]
    (left, right), (start_l, start_r) = boxes, (_phase(camera) for camera in (reference, second))
    top = floor(left[1] - start_l[1]) + start_l[1]
    height = ceil(left[3] - top) + 1
    grids = [Grid(floor(box[0] - start[0]) + start[0], top, ceil(box[2] - box[0]) + 2, height)
             for box, start in ((left, start_l), (right, start_r))]
    for grid, camera in zip(grids, (reference, second), strict=True):
        if grid.width * grid.height > MOST_GROWTH * max(camera.width * camera.height, reference.width * reference.height):
            raise ManifestError(f"{where}.camera_from_other: the cameras look in directions that are too different to be rectified "
                                f"({grid.width}x{grid.height} pixels)")
    return Rectification(reference, second, from_reference, from_other, focal, baseline, *grids)


def _phase(camera: Camera) -> tuple[float, float]:
    """Return the fraction of a pixel at which the centres of a camera's pixels lie from its principal point, so that images that are
    rectified already are not resampled."""
    cu, cv = camera.principal_point
    return (0.5 - cu) % 1.0, (0.5 - cv) % 1.0


def _extent(camera: Camera, turn: np.ndarray, focal: float, where: str) -> tuple[float, float, float, float]:
    """Return the least x and y and the largest of a camera's image in the rectified plane, in pixels."""
    along = np.linspace(0, 1, BORDER)
    u = np.concatenate([along, along, np.zeros(BORDER), np.ones(BORDER)]) * (camera.width - 1) + 0.5
    v = np.concatenate([np.zeros(BORDER), np.ones(BORDER), along, along]) * (camera.height - 1) + 0.5
    x, y = camera.plane_at(u, v)
    towards = np.stack([x, y, -np.ones_like(x)], axis=-1) @ turn.T
    if towards[:, 2].min() <= 0.05:
        raise ManifestError(f"{where}.camera_from_other: the cameras look in directions that are too different to be rectified")
    at = focal * towards[:, :2] / towards[:, 2:]
    return float(at[:, 0].min()), float(at[:, 1].min()), float(at[:, 0].max()), float(at[:, 1].max())


class RectifiedFrames(NamedTuple):
    """Images of two cameras whose rows agree; both are smoothed by the binomial filter 1 2 1, because texture finer than the pixels is
    aliased and misleads the comparison of two cameras."""

    left: np.ndarray  # [frames, rows, cols] float32, linear, of the reference camera
    right: np.ndarray  # [frames, rows, right cols] float32, of the other camera
    left_seen: np.ndarray  # [rows, cols] bool, False where the camera saw nothing
    right_seen: np.ndarray  # [rows, right cols] bool


@contextmanager
def rectified_frames(capture: Capture, frames: Sequence[Frame], other: int, rectification: Rectification, *, cache: Path | None = None,
                     progress: Callable[[int], None] | None = None) -> Iterator[RectifiedFrames]:
    """Read and rectify the frames of the reference camera and of one other, and yield images that exist until the block ends.
    `other`: index of the other camera. `cache`: the folder for the scratch file; None stands for `.relit` in the folder of the capture.
    No file is left in it. `progress`: called after every frame with the count of frames that have been read."""
    grids = rectification.left, rectification.right
    size = 4 * len(frames) * sum(grid.width * grid.height for grid in grids)
    with scratch_arrays(size, capture, cache) as allocate:
        images = [allocate((len(frames), grid.height, grid.width), np.float32) for grid in grids]
        seen = [np.ones((grid.height, grid.width), bool) for grid in grids]
        for index, frame in enumerate(frames):
            assert frame.stereo is not None  # the caller chose stereo frames
            recorded = capture.recorded(frame.image), capture.recorded_whole(frame.stereo.images[other])
            for side, pixels in enumerate(recorded):
                linear = linearise(pixels, capture.manifest.color_space) @ np.array(GREY_WEIGHTS, np.float32)
                values, held = rectification.rows_of(smoothed(linear / np.float32(frame.exposure_s or 1.0)), other=side == 1)
                images[side][index] = values
                seen[side] &= held
            if progress is not None:
                progress(index + 1)
        yield RectifiedFrames(images[0], images[1], seen[0], seen[1])


def smoothed(image: np.ndarray) -> np.ndarray:
    """Return an image [rows, cols] float32, smoothed by the binomial filter 1 2 1 along rows and columns; borders are continued."""
    return np.asarray(correlate1d(correlate1d(image, BINOMIAL, axis=0, mode="nearest"), BINOMIAL, axis=1, mode="nearest"))
