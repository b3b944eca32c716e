"""Whether the places that two cameras see contradict the calibration of the second: said, and held by σ; or so far that nothing fits."""

import numpy as np

from service.depth.base.epipolar import Contradiction, contradiction, difference, places_aside
from service.depth.stereo.rectification import Rectification
from service.depth.stereo.row_offsets import RowOffsets
from stage.capture.camera import Camera, OtherCamera
from stage.capture.projector import Projector
from stage.spread import MAD_TO_SIGMA, blocks_of

LEAST_PX = 0.012
"""Least systematic distance from the epipolar lines that is one: interpolation and noise leave a fifth of it."""
TURNED = 4
"""Number of parameters that are fitted, turns and focal length: those of a camera that was hit or focused after it was calibrated. What
boards leave open of the others compensates in places and depths, so that no line tells it."""
CHANCE_PX = 0.25
"""Median difference of the row offsets of neighbouring places from which these match by chance. A camera that is rolled by a degree leaves
a tenth, chance four tenths."""
ENOUGH = 50
"""Places from which an offset between rows is told."""
UNEXPLAINED_PX, SAID_PX = 0.06, 0.2
"""Systematic offsets between rows that no turn explains, from which σ holds them and from which they are said. Exact cameras leave .015 px,
those of boards that fill the image up to .046, those of boards in its middle up to .19 (and 1 to 10 % beyond 5 σ if σ does not hold it); a
distortion that is left out, .24 to .32, with 41 to 48 % beyond."""
LEAST_OF_BLOCK, OF_A_MEDIAN = 4, np.pi / 2 * MAD_TO_SIGMA**2
"""Places of a block of which a median is taken, and its variance over the square of the median deviation and the number of places."""


def as_projector(camera: OtherCamera | Camera, camera_from_other: np.ndarray) -> Projector:
    """Return a calibrated camera as the projector of another one, which has the same geometry. `camera_from_other`: [4, 4], metres."""
    return Projector.model_validate({
        "resolution": camera.resolution, "focal_px": camera.focal_px, "principal_px": camera.principal_px, "distortion": camera.distortion,
        "camera_from_projector": camera_from_other.tolist()})


def as_camera(view: Projector, name: str) -> OtherCamera:
    """Return the camera that `as_projector` was given."""
    return OtherCamera(name=name, resolution=view.resolution, focal_px=view.focal_px, principal_px=view.principal_px,
                       distortion=view.distortion, camera_from_other=view.camera_from_projector)


def contradicted(offsets: RowOffsets, geometry: Rectification, other: Projector, before: Contradiction | None = None, *,
                 free: int = TURNED) -> Contradiction | None:
    """Return how the places that both cameras see contradict the calibration of the other; None where noise explains them.
    `before`: the contradiction by which the other camera was found. `free`: number of parameters that are fitted."""
    focal, left, right = geometry.focal_px, geometry.left, geometry.right
    whole = offsets.disparity + geometry.offset_px
    ahead = whole > 0
    row, col, disparity, offset, sigma = (each[ahead] for each in offsets)
    depth = focal * geometry.baseline_m / whole[ahead]
    points = _towards(left.left + col, left.top + row, focal) * depth[:, None] @ geometry.rectified_from_reference
    seen = _towards(right.left + col - disparity, right.top + row + offset, focal) @ geometry.rectified_from_other
    places = np.stack(geometry.other.image_coordinates(seen / -seen[:, 2:]), axis=1)
    return contradiction(other, points, places, np.stack([sigma, sigma], axis=1), least_px=LEAST_PX, free=free, typed=False,
                         before=before)


def unexplained_px(offsets: RowOffsets) -> float:
    """Return the root mean square of the medians of the row offsets in blocks of the image, beyond what noise makes of them, pixels."""
    block = blocks_of(offsets.col, offsets.row)
    parts = [part for part in (offsets.offset[block == number] for number in np.unique(block)) if len(part) >= LEAST_OF_BLOCK]
    if not parts:
        return 0.0
    square = [float(np.median(part)**2 - np.median(np.abs(part - np.median(part)))**2 * OF_A_MEDIAN / len(part)) for part in parts]
    return float(np.sqrt(max(np.average(square, weights=[len(part) for part in parts]), 0.0)))


def by_chance(offsets: RowOffsets) -> bool:
    """Return whether places match by chance, so that the offsets of neighbours, which follow each other along the rows, differ."""
    return len(offsets.offset) >= ENOUGH and float(np.median(np.abs(np.diff(offsets.offset)))) > CHANCE_PX


def widened(depth: np.ndarray, sigma: np.ndarray, camera: Camera, found: Contradiction, given: Projector) -> np.ndarray:
    """Return the standard deviations of depths with the error that a contradiction makes, [rows, cols] float32 metres.
    `depth`, `sigma`: [rows, cols] metres, 0 where there is no depth. `given`: the other camera as it was given; depths may be those of one
    that was found."""
    known = depth > 0
    wider = sigma.copy()
    wider[known] = np.hypot(sigma[known], found.error(camera.points(-depth)[known], given=given))
    return wider


def sentence(name: str, found: Contradiction, given: Projector, camera: Camera) -> str:
    """Return what is said of a camera whose calibration is contradicted.
    `name`: the field of the camera and its name. `given`: the camera as it was given. `camera`: the first one."""
    seen = f"{name}: the places that both cameras see contradict its calibration"
    if found.aside:
        places = places_aside(found, given, camera, ("its camera", "the first camera"))
        return (f"{seen} by {found.size_px:.2g} px, {places}: check whether it is that of these images, or calibrate the cameras again "
                "(relit calibrate stereo); the standard deviations hold the error that this makes")
    if not found.plausible:
        return (f"{name}: where both cameras see the same places contradicts its calibration by more than a camera can be off: images that "
                "are mirrored, upside down or of another camera do that, and a pose that is the inverse of the right one; no depth "
                "of it is trusted")
    if given is not found.declared:
        return (f"{seen}, {difference(given, found.declared)}: depths are those of a camera that is ({found.noise_px:.2g} px are left), "
                "which report.json holds under found, and the standard deviations hold what this leaves open")
    return (f"{seen} by {found.size_px:.2g} px ({found.noise_px:.2g} px are left by noise), {difference(found.declared, found.projector)}: "
            "calibrate the cameras again (relit calibrate stereo), or take it as found (--refine-projector); the standard deviations hold "
            "the error that this makes")


def _towards(x: np.ndarray, y: np.ndarray, focal_px: float) -> np.ndarray:
    """Return the directions of places of the rectified plane, [places, 3] at depth 1."""
    return np.stack([x, y, np.full(x.shape, focal_px)], axis=-1) / focal_px
