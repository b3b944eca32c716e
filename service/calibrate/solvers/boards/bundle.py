"""Cameras and projectors that see the same boards, fitted to the corners of all views at once, and how sure that is.

That corners fit says little: boards that all lie alike are explained as well by another focal length and other distances. The covariance of
all parameters, those of the poses of the boards among them, tells by how much depths may be off. Boards are not quite flat: their form is
a parameter too, of second order across and down.

Source: Hartley and Zisserman, "Multiple View Geometry in Computer Vision", 2nd ed. 2004, chapter 5 for the covariance of an estimate, and
    chapter 18 for the adjustment of bundles; Zhang, "A flexible new technique for camera calibration", TPAMI 22(11), 2000, section 3, for
    the parallel poses that leave a lens open.

Convention: the axes of OpenCV, y down, z forward, but for `Bundle.pose`.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from service.calibrate.solvers.boards.alone import TILT, Alone, Pinhole, Sight, alone, moved, sights_of
from stage.errors import CalibrationError
from stage.importers.opencv_file import camera_from_projector

LENS, POSE, BEND = 8, 6, 3
"""Parameters of a lens (focal lengths, principal point, k1, k2, p1, p2), of a pose (rotation vector and translation), and of the board's
form (heights of x², xy and y², each 1 at its outermost corners)."""
BENT = 6.0
"""Standard deviations of a bend, from which what a device leaves alone is taken on bent boards."""
TOLD_BEND = 0.002
"""Height of a bend, as a part of the board's length, from which it is said: what corners are off by as their finder is must not be."""
DOUBTED, REFUSED = 0.01, 0.03
"""Standard deviation of depths, as a part of them, from which a calibration is remarked on, and from which it is none: beyond it another
focal length far away fits as well, which the covariance does not tell."""
GRID = 16
"""Places across and down the image at which the standard deviation of depths is taken; it changes smoothly."""
MOST_STEPS = 100
"""Evaluations after which a fit ends: where the boards determine the devices a dozen are enough."""
UP = np.array([0.0, 0.0, 1.0])
"""The normal of a board."""


def bend_words(height_m: float, length_m: float) -> list[str]:
    """Return what there is to say of a board whose highest corner is so high above its lowest."""
    said = f"the board is bent by {1000 * height_m:.2g} mm over {1000 * length_m:.0f} mm, which is fitted: a flat one is surer"
    return [said] if height_m > TOLD_BEND * length_m else []


class Certainty(NamedTuple):
    """Standard deviations of two devices, and of the depths that are triangulated with both."""

    focal: tuple[float, float]
    """The standard deviation of each device's focal length, as a part of that length."""
    principal_px: tuple[float, float]
    """The standard deviation of each device's principal point, in pixels."""
    depth: float
    """The standard deviation of depths over the image, as a part of the depth: root mean square over all places that both devices see."""
    depth_at_boards: float
    """The same over the corners of the boards."""
    covered: float
    """The part of the first device's image in which boards were."""
    bend: tuple[float, float]
    """The height of the board's highest corner above its lowest, 0 where it is flat to what noise leaves, and its length, in metres."""
    contradiction: str | None = None
    """What there is to say of devices that contradict each other."""

    def facts(self) -> dict[str, Any]:
        """Return the standard deviations as the report has them."""
        return {"depth": float(f"{self.depth:.3g}"), "depth_at_boards": float(f"{self.depth_at_boards:.3g}"),
                "focal": [float(f"{part:.3g}") for part in self.focal],
                "principal_px": [float(f"{pixels:.3g}") for pixels in self.principal_px]}

    def warnings(self) -> list[str]:
        """Return what there is to say of depths that are not sure, and of a board that is not flat."""
        return [*self._doubts(), *bend_words(*self.bend)]

    def _doubts(self) -> list[str]:
        if self.contradiction is not None:
            return [f"{self.contradiction} (depths are known to {100 * self.depth:.2g} % alone)"]
        if self.depth_at_boards > DOUBTED:
            return [f"depths are known to {100 * self.depth_at_boards:.2g} % alone: {TILT}"]
        return [f"depths are known to {100 * self.depth_at_boards:.2g} % where boards were, in {100 * self.covered:.0f} % of the image, "
                f"and to {100 * self.depth:.2g} % over all of it: show the board up to the edges too"] if self.depth > DOUBTED else []


class Bundle(NamedTuple):
    """Devices and boards that explain all corners best."""

    sights: list[Sight]
    alone: list[Alone]
    lenses: list[Pinhole]
    places: np.ndarray  # [devices, 6] rotation vector and translation from the first device to each, zeros for the first
    boards: dict[int, np.ndarray]
    """By the number of each view: rotation vector and translation [6] from the board to the first device."""
    errors_px: np.ndarray  # [sights] root mean square
    covariance: np.ndarray  # of the parameters of all lenses and then of all places but the first
    excess: float
    """What the corners are off because the devices share boards and places, relative to what noise would leave: 1 but for chance."""
    bend: np.ndarray  # [BEND] metres, of boards beyond the form that `sights` have

    def rms_px(self, counted: Sequence[bool] | None = None) -> float:
        """Return the root mean square error of the corners. `counted`: of each sight, whether its corners count; None: all do."""
        weights = np.array([len(sight.board) for sight in self.sights])
        return float(np.sqrt(np.average(self.errors_px**2, weights=weights if counted is None else weights * counted)))

    def pose(self, device: int) -> np.ndarray:
        """Return where a device stands in the frame of the first one, [4, 4] metres, both with the axes of a manifest's cameras."""
        return camera_from_projector(cv2.Rodrigues(self.places[device, :3])[0], self.places[device, 3:])

    def certainty(self, device: int, name: str, contradiction: str | None = None) -> Certainty:
        """Return how sure a device and the first one are. `contradiction`: what there is to say where they contradict each other.
        Raises CalibrationError: the poses of the board leave depths open, or the devices contradict each other."""
        own = np.r_[:LENS, LENS * device:LENS * (device + 1), LENS * len(self.lenses) + POSE * (device - 1) + np.arange(POSE)]
        covariance = self.covariance[np.ix_(own, own)]
        sigma = np.sqrt(np.diag(covariance)[:2 * LENS]).reshape(2, LENS)
        focal = np.array([np.diag(self.lenses[of].matrix)[:2] for of in (0, device)])
        if focal.min() <= 0:
            raise CalibrationError(contradiction or f"the poses of the board do not determine {name}: a focal length comes out as "
                                   f"{focal.min():.3g} px: {TILT}")
        seen = {sight.view for sight in self.sights if sight.device == device}
        sights = [sight for sight in self.sights if not sight.device and sight.view in seen]
        corners = np.concatenate([moved(sight.board, self.boards[sight.view]) for sight in sights])
        at_boards = float(np.sqrt(self._depth_variances(corners, device, covariance).mean()))
        if not at_boards < REFUSED:  # nor is it when it is no number
            known = f"depths would be known to {100 * at_boards:.2g} % alone" if at_boards < 1 else "depths would be unknown"
            open_alone = not at_boards < REFUSED * max(self.excess, 1.0)**0.5  # were there no contradiction
            raise CalibrationError(f"the poses of the board do not determine {name}: {known}: {TILT}" if contradiction is None or open_alone
                                   else f"{contradiction} ({known})")
        image, lost = self._image_points(device, float(np.median(corners[:, 2])))
        variances = np.minimum(self._depth_variances(image, device, covariance), 1) if len(image) else np.zeros(0)
        depth = float(np.sqrt((variances.sum() + lost) / max(len(image) + lost, 1)))
        first, other = (sigma[:, :2] / focal).max(axis=1)
        across, down, height = np.ptp(np.concatenate([sight.board for sight in self.sights]), axis=0)
        return Certainty((float(first), float(other)), (float(sigma[0, 2:4].max()), float(sigma[1, 2:4].max())), max(depth, at_boards),
                         at_boards, _covered(sights, self.alone[0].size), (float(height), float(max(across, down))), contradiction)

    def _image_points(self, device: int, depth: float) -> tuple[np.ndarray, int]:
        """Return points at a depth that are spread over the image of the first device and that the other one sees, [points, 3], and the
        count of places in that image which its lens, as it is found, cannot have."""
        size, (matrix, distortion) = self.alone[0].size, self.lenses[0]
        pixels = np.stack(np.meshgrid(*(np.linspace(0, side - 1, GRID) for side in size)), axis=-1).reshape(-1, 1, 2)
        rays = cv2.undistortPoints(pixels, matrix, distortion, criteria=(cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-9))
        points = np.nan_to_num(cv2.convertPointsToHomogeneous(rays).reshape(-1, 3) * depth, posinf=0.0, neginf=0.0)
        again, there = (cv2.projectPoints(points, pose[:3], pose[3:], *lens)[0].reshape(-1, 2) for pose, lens in (
            (np.zeros(POSE), self.lenses[0]), (self.places[device], self.lenses[device])))
        known = np.linalg.norm(again - pixels[:, 0], axis=1) < 1
        seen = ((there >= 0) & (there <= self.alone[device].size)).all(axis=1)
        return points[known & seen], int((~known).sum())

    def _depth_variances(self, points: np.ndarray, device: int, covariance: np.ndarray) -> np.ndarray:
        """Return the variance of the depth of each point [points, 3], relative to it, what is seen being held.
        `covariance`: of lens, other lens and place, [22, 22]."""
        count = len(points)
        place = self.places[device]
        by_first, by_second = (cv2.projectPoints(points, pose[:3], pose[3:], *lens)[1].reshape(count, 2, -1) for pose, lens in (
            (np.zeros(POSE), self.lenses[0]), (place, self.lenses[device])))
        here, there = by_first[..., 3:POSE], by_second[..., 3:POSE] @ cv2.Rodrigues(place[:3])[0]  # by the place of the point
        way = np.einsum("nij,nj->ni", there, points)  # by the part of its depth, along the line of sight
        aside = -np.linalg.solve(here[..., :2], by_first[..., POSE:POSE + LENS])  # of the point at its depth
        off = np.concatenate([there[..., :2] @ aside, by_second[..., POSE:POSE + LENS], by_second[..., :POSE]], axis=-1)
        slopes = -np.einsum("ni,nij->nj", way, off) / np.maximum((way**2).sum(axis=1), 1e-300)[:, None]
        return np.einsum("ni,ij,nj->n", slopes, covariance, slopes)


def adjust(sights: Sequence[Sight], devices: Sequence[Alone]) -> Bundle:
    """Fit lenses, places and boards to the corners of all sights, also the form that boards share. Each device shares a view or more with
    the first."""
    found = _adjusted(sights, devices)
    if not (np.abs(found.bend) > BENT * np.sqrt(np.diag(found.covariance)[-BEND:])).any():
        return found
    bent = [sight._replace(board=sight.board + np.outer(bend @ found.bend, UP)) for sight, bend in zip(sights, _bends(sights), strict=True)]
    again = [alone(sights_of(number, bent), device.size, "a device", lens.matrix)
             for number, (device, lens) in enumerate(zip(devices, found.lenses, strict=True))]
    worse = any(now.rms_px > before.rms_px for now, before in zip(again, devices, strict=True))
    return found if worse else _adjusted(bent, again)  # what contradicts otherwise may look like a bend, but to no device alone


def _adjusted(sights: Sequence[Sight], devices: Sequence[Alone]) -> Bundle:
    places = [np.zeros(POSE), *(_place(devices[0], other) for other in devices[1:])]
    views = sorted({sight.view for sight in sights})
    boards = []
    for view in views:
        number, pose = next((number, device.boards[view]) for number, device in enumerate(devices) if view in device.boards)
        back = inverse(places[number])
        boards.append(after(pose, back))
    start = np.concatenate([*(_values(device.lens) for device in devices), *places[1:], np.zeros(BEND), *boards])
    shared = len(start) - POSE * len(views)
    form = slice(shared - BEND, shared)
    bends = _bends(sights)

    def parts(values: np.ndarray) -> tuple[list[Pinhole], np.ndarray, dict[int, np.ndarray]]:
        lenses = [_lens(values[LENS * device:LENS * (device + 1)]) for device in range(len(devices))]
        places = np.concatenate([np.zeros(POSE), values[LENS * len(devices):form.start]]).reshape(-1, POSE)
        return lenses, places, dict(zip(views, values[shared:].reshape(-1, POSE), strict=True))

    def shown(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return by how much all corners are off, [2 corners of all sights], and the slopes by all parameters."""
        lenses, places, boards = parts(values)
        offs, rows = [], []
        for sight, bend in zip(sights, bends, strict=True):
            board, place = boards[sight.view], places[sight.device]
            posed = cv2.composeRT(board[:3], board[3:], place[:3], place[3:])  # with derivatives by the four
            seen, by = cv2.projectPoints(sight.board + np.outer(bend @ values[form], UP), *posed[:2], *lenses[sight.device])
            by_board, by_place = (np.block([[posed[2 + of], posed[3 + of]], [posed[6 + of], posed[7 + of]]]) for of in (0, 2))
            row = np.zeros((2 * len(sight.board), len(start)))
            row[:, LENS * sight.device:LENS * (sight.device + 1)] = by[:, POSE:POSE + LENS]
            if sight.device:
                first = LENS * len(devices) + POSE * (sight.device - 1)
                row[:, first:first + POSE] = by[:, :POSE] @ by_place
            row[:, form] = (by[:, 3:POSE] @ cv2.Rodrigues(posed[0])[0] @ UP)[:, None] * np.repeat(bend, 2, axis=0)
            first = shared + POSE * views.index(sight.view)
            row[:, first:first + POSE] = by[:, :POSE] @ by_board
            offs.append((seen.reshape(-1, 2) - sight.corners).ravel())
            rows.append(row)
        return np.concatenate(offs), np.concatenate(rows)

    found = least_squares(lambda values: shown(values)[0], start, jac=lambda values: shown(values)[1], x_scale="jac", method="lm",
                          max_nfev=MOST_STEPS).x
    off, slopes = shown(found)
    of_device = np.concatenate([np.full(2 * len(sight.board), sight.device) for sight in sights])
    errors = np.split(off, np.cumsum([2 * len(sight.board) for sight in sights])[:-1])
    covariance, excess = _covariance(slopes, off, of_device, devices)
    return Bundle(list(sights), list(devices), *parts(found), np.array([np.sqrt(2 * np.mean(error**2)) for error in errors]),
                  covariance[:shared, :shared], excess, found[form])


def _covariance(slopes: np.ndarray, off: np.ndarray, of_device: np.ndarray, devices: Sequence[Alone]) -> tuple[np.ndarray, float]:
    """Return the covariance of a fit by least squares, infinite where something is open, and `Bundle.excess`.

    The noise of each device is what it leaves alone. What the devices leave together beyond that is spent on the parameters that they
    share, so that the covariance grows with it as with noise."""
    unit = 1 / np.maximum(np.linalg.norm(slopes, axis=0), 1e-300)
    scaled = slopes * unit
    try:
        inverse = np.linalg.inv(scaled.T @ scaled)
    except np.linalg.LinAlgError:
        return np.full((len(unit), len(unit)), np.inf), 1.0
    spread, left, expected = np.zeros_like(inverse), 0.0, 0.0
    for device, fitted in enumerate(devices):
        own = scaled[of_device == device]
        normal = own.T @ own
        parameters = LENS + POSE * len(fitted.boards)
        squares = fitted.rms_px**2 * len(own) / 2
        noise = squares / max(len(own) - parameters, 1)
        spread += normal * noise
        left += float((off[of_device == device]**2).sum()) - squares
        expected += noise * (parameters - float((inverse * normal).sum()))
    excess = left / max(expected, 1e-300)
    return np.asarray(inverse @ spread @ inverse * unit * unit[:, None]) * max(excess, 1.0), excess


def _place(first: Alone, other: Alone) -> np.ndarray:
    """Return a pose from the first device to another one, from the boards that both see."""
    poses = np.array([after(inverse(first.boards[view]), other.boards[view]) for view in first.boards.keys() & other.boards.keys()])
    return np.concatenate([Rotation.from_rotvec(poses[:, :3]).mean().as_rotvec(), np.median(poses[:, 3:], axis=0)])


def _bends(sights: Sequence[Sight]) -> list[np.ndarray]:
    """Return, for each sight, by how much its corners are higher on a board of a bend of 1, [corners, BEND]."""
    corners = np.concatenate([sight.board[:, :2] for sight in sights])
    heights = second_order(corners, corners.min(axis=0), corners.max(axis=0))
    return np.split(heights, np.cumsum([len(sight.board) for sight in sights])[:-1])


def second_order(points: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return x², xy and y² of places on a board [points, 2], [points, BEND], x and y from -1 to 1 between its outermost corners."""
    x, y = ((2 * points - low - high) / (high - low)).T
    return np.stack([x**2, x * y, y**2], axis=-1)


def _covered(sights: Sequence[Sight], size: tuple[int, int]) -> float:
    """Return the part of an image that lies in the outline of the corners of any of the sights."""
    inside = np.zeros(size[::-1], np.uint8)
    for sight in sights:
        cv2.fillConvexPoly(inside, cv2.convexHull(sight.corners.astype(np.float32)).astype(np.int32), 1)
    return float(inside.mean())


def after(pose: np.ndarray, then: np.ndarray) -> np.ndarray:
    """Return a pose and then another one, each [6]."""
    return np.concatenate([part.ravel() for part in cv2.composeRT(pose[:3], pose[3:], then[:3], then[3:])[:2]])


def inverse(pose: np.ndarray) -> np.ndarray:
    """Return the way back of a pose [6]."""
    back = -pose[:3]
    return np.concatenate([back, -Rotation.from_rotvec(back).apply(pose[3:])])


def _values(lens: Pinhole) -> np.ndarray:
    """Return the parameters of a lens, [LENS]."""
    return np.concatenate([np.diag(lens.matrix)[:2], lens.matrix[:2, 2], lens.distortion])


def _lens(values: np.ndarray) -> Pinhole:
    return Pinhole(np.array([[values[0], 0, values[2]], [0, values[1], values[3]], [0, 0, 1]]), values[4:])
