"""Laser planes from their stripes on a step of known height: a right-angled block on a flat base, whose pose nobody has measured.

A plane of light q·X = 1 meets a face a·X = α of the step in the line whose image is (a - α q)·(x, y, -1) = 0. The base g·X = 1, the top
g·X = 1 - h |g|, which lies h nearer to the camera, and the riser m·X = ρ at right angles to both, have five unknowns for each pose of the
step (and a sixth: how far the riser leans, which is known to be little), each laser plane has three, and the stripe of a laser gives up to
six numbers, two for each line: all are found together by least squares. The beginning is closed: a stripe on base and top gives one
direction of the base, as do the feet and the edges of the riser over several stripes, and the height of the riser gives the distance.

Source: the direction of two parallel lines from their images, Haralick, "Monocular vision using inverse perspective projection geometry",
CVPR 1989; plane and stripe by nonlinear least squares as in Zhou and Zhang (`laser_plane`).
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import OptimizeResult, least_squares

from service.calibrate.solvers.step_stripe import Segment, StepStripe, best_line
from stage.errors import CalibrationError

NUMBERS = 6
"""Unknowns of a pose: g, the direction of the riser in the base, ρ, and how far the riser leans."""
LEAN = math.radians(0.25)
"""Standard deviation of the angle between riser and base about 90°, of machined or well cut blocks."""
SETTLED = 1e-12
"""Parts of the sum of squares, of the parameters and of the gradient by which the last step changes them."""
LARGEST_SIGMA, LARGEST_SIGMA_DEGREES = 0.02, 1.0
"""The largest standard errors of a plane that is written: of depths on it as a part of them, and of its tilt."""

LEAST_POSES = 2
"""Poses of the step from which a focal length follows."""
FACE_PX = 4.0
"""Pixels by which the foot or the edge of a stripe's riser may lie beside the line of the others on one upright face."""


class StepPlane(NamedTuple):
    """A plane of light through the stripes on steps."""

    point: np.ndarray  # [3] metres, in the middle of its stripes
    normal: np.ndarray  # [3] unit
    residual_px: float
    """Root mean square distance of its lines from where the fit puts them."""
    sigma_m: float
    """Standard error of its place at the point, along the normal."""
    sigma_degrees: float
    """Standard error of the normal in its worst direction."""
    sigma: float
    """Standard error of depths on it where its stripes were, as a part of them."""
    stripes: int
    """Number of poses that show it."""


class StepFit(NamedTuple):
    """The planes, and the poses of the step."""

    planes: list[StepPlane]
    distances_m: list[float]
    """Distance of the base from the camera's centre in each pose."""
    focal: tuple[float, float] | None
    """Focal length by which the stripes fit best over that of the camera, and its standard error; None from one pose, which tells none."""
    beside: list[tuple[np.ndarray, np.ndarray]]
    """Point and normal of each plane by that focal length."""


def fit_step(poses: Sequence[Sequence[StepStripe | None]], height_m: float, pixel: float) -> StepFit:
    """Fit the planes of lasers to their stripes on a step in one pose or several.
    `poses`: for each pose the stripe of each laser plane; None where it does not cross the block. `pixel`: width of a pixel in normalised
    coordinates. Raises CalibrationError if a pose shows too little of the step, a plane is seen in none, or the stripes do not determine
    them."""
    count = len(poses[0])
    for number in range(count):
        if not any(pose[number] is not None for pose in poses):
            raise CalibrationError(f"frame {number + 1} of the laser: its stripe is not seen to cross base, block and base: put the block "
                                   "into the middle of the stripe")
    poses = [_one_face(pose, FACE_PX * pixel) for pose in poses]
    steps, planes = zip(*(_begin(number, pose, height_m) for number, pose in enumerate(poses)), strict=True)
    middle = np.array([np.mean([shown[number] for shown in planes if number in shown], axis=0) for number in range(count)])
    values = np.concatenate([np.concatenate(steps), middle.ravel()])
    data = _Data.of(poses, height_m)
    found = _solved(data, np.append(values, 1.0), free=False)
    values, residual, jacobian = found.x, found.fun, found.jac
    freedom = len(residual) - len(values)
    if freedom < 1:
        raise CalibrationError("the stripes do not determine the planes: photograph more places of the laser on the step")
    spread = math.sqrt(float(residual @ residual) / freedom)
    normal_matrix = jacobian.T @ jacobian
    scale = np.sqrt(np.maximum(np.diag(normal_matrix), 1e-300))
    whitened = normal_matrix / np.outer(scale, scale)
    covariance = np.linalg.pinv(whitened, rcond=1e-14, hermitian=True) / np.outer(scale, scale) * max(spread, 1.0) ** 2
    lost = np.linalg.eigvalsh(whitened)[0] < 1e-13
    lasers = [_plane(data, values, residual, covariance, number, pixel) for number in range(count)]
    worst = max(lasers, key=lambda plane: plane.sigma)
    if lost or worst.sigma > LARGEST_SIGMA or max(plane.sigma_degrees for plane in lasers) > LARGEST_SIGMA_DEGREES:
        told = "hardly" if lost or worst.sigma > 1 else f"to {100 * worst.sigma:.1f} % of the depth and {worst.sigma_degrees:.1f}° alone"
        raise CalibrationError(f"the step tells the planes {told}: look at it from 30 to 60 degrees above its base, let it fill more of "
                               "the image, take a higher one, or photograph it in several poses")
    distances = [1 / float(np.linalg.norm(values[NUMBERS * pose:NUMBERS * pose + 3])) for pose in range(len(poses))]
    if len(poses) < LEAST_POSES:
        return StepFit(lasers, distances, None, [])
    again = _solved(data, np.append(values, 1.0), free=True)
    noise = max(float(again.fun @ again.fun) / max(len(again.fun) - len(again.x), 1), 1.0)
    scale = np.maximum(np.linalg.norm(again.jac, axis=0), 1e-300)
    sigma = math.sqrt(noise * float(np.linalg.pinv((again.jac / scale).T @ (again.jac / scale), hermitian=True)[-1, -1])) / scale[-1]
    beside = []
    for plane in again.x[NUMBERS * data.poses:-1].reshape(-1, 3):
        length = float(np.linalg.norm(plane))
        beside.append((plane / length**2, plane / length))
    return StepFit(lasers, distances, (float(again.x[-1]), float(sigma)), beside)


def _solved(data: "_Data", start: np.ndarray, *, free: bool) -> OptimizeResult:
    """Return the least-squares fit of poses and planes from `start`, whose last number is the focal length over that of the camera.
    `free`: whether that is fitted too; otherwise the fit has all numbers but it."""
    def residual(values: np.ndarray) -> np.ndarray:
        focal = values[-1] if free else start[-1]
        return data.residual(values[:len(start) - 1], focal)

    return least_squares(residual, start if free else start[:-1], jac="3-point", method="lm", x_scale="jac", ftol=SETTLED, xtol=SETTLED,
                         gtol=SETTLED)


class _Data(NamedTuple):
    """The lines of all stripes as numbers."""

    face: np.ndarray  # [lines] 0 base, 1 top, 2 riser
    pose: np.ndarray  # [lines]
    laser: np.ndarray  # [lines]
    ends: np.ndarray  # [lines, 2, 3] (x, y, -1)
    weight: np.ndarray  # [lines] over the standard deviation
    poses: int
    height_m: float

    @classmethod
    def of(cls, poses: Sequence[Sequence[StepStripe | None]], height_m: float) -> "_Data":
        """Return the lines of stripes."""
        rows = [(face, pose, laser, segment) for pose, stripes in enumerate(poses) for laser, stripe in enumerate(stripes)
                if stripe is not None for face, segment in enumerate((stripe.base, stripe.top, stripe.riser)) if segment is not None]
        face, pose, laser = (np.array([row[part] for row in rows]) for part in range(3))
        ends = np.array([np.hstack([row[3].ends, -np.ones((2, 1))]) for row in rows])
        weight = np.array([row[3].weight**0.5 / row[3].noise for row in rows])
        return cls(face, pose, laser, ends, weight, len(poses), height_m)

    def residual(self, values: np.ndarray, focal: float = 1.0) -> np.ndarray:
        """Return the distances of the ends of each line from its place, and the leans, in standard deviations, [2 lines + poses].
        `focal`: focal length over that by which the coordinates are normalised."""
        steps = values[:NUMBERS * self.poses].reshape(-1, NUMBERS)[self.pose]
        laser = values[NUMBERS * self.poses:].reshape(-1, 3)[self.laser]
        base = steps[:, :3]
        length = np.linalg.norm(base, axis=1, keepdims=True)
        across, along = _in_plane(base / length)
        riser = np.cos(steps[:, 3:4]) * across + np.sin(steps[:, 3:4]) * along + steps[:, 5:] * base / length
        face = self.face[:, None]
        normal = np.where(face == 2, riser, base)
        offset = np.where(face == 0, 1.0, np.where(face == 1, 1 - self.height_m * length, steps[:, 4:5]))
        line = normal - offset * laser
        line = line / np.maximum(np.linalg.norm(line[:, :2], axis=1, keepdims=True), 1e-12)
        off = np.einsum("lec,lc->le", self.ends / np.array([focal, focal, 1.0]), line) * self.weight[:, None]
        return np.concatenate([off.ravel(), values[:NUMBERS * self.poses].reshape(-1, NUMBERS)[:, 5] / LEAN])


def _in_plane(normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return two directions at right angles to unit normals and to each other, [n, 3] each."""
    aside = np.cross(normal, np.array([0.0, 1.0, 0.0]))
    flat = np.linalg.norm(aside, axis=1, keepdims=True) < 0.3
    aside = np.where(flat, np.cross(normal, np.array([1.0, 0.0, 0.0])), aside)
    aside = aside / np.linalg.norm(aside, axis=1, keepdims=True)
    return aside, np.cross(normal, aside)


def _one_face(stripes: Sequence[StepStripe | None], tolerance: float) -> list[StepStripe | None]:
    """Return the stripes of a pose without risers on another upright face than most: stripes near a corner of the block cross that."""
    found, rising = list(stripes), [stripe for stripe in stripes if stripe is not None and stripe.riser is not None]
    if len(rising) < 3:
        return found
    kept = np.ones(len(rising), bool)
    for meets in ([_meet(stripe.base, stripe.riser) for stripe in rising if stripe.riser is not None],
                  [_meet(stripe.top, stripe.riser) for stripe in rising if stripe.riser is not None]):
        kept &= best_line(np.array(meets)[:, :2], tolerance, np.random.default_rng(0))[1]
    others = [stripe for stripe, own in zip(rising, kept, strict=True) if not own and kept.sum() > 1]
    return [stripe._replace(riser=None) if stripe is not None and any(stripe is other for other in others) else stripe for stripe in found]


def _begin(number: int, stripes: Sequence[StepStripe | None], height_m: float) -> tuple[np.ndarray, dict[int, np.ndarray]]:
    """Return the numbers of a pose, and the laser planes that it shows."""
    shown = {index: stripe for index, stripe in enumerate(stripes) if stripe is not None}
    side = 1 if sum(stripe.side for stripe in shown.values() if stripe.riser is not None) > 0 else -1
    whole = [stripe for stripe in shown.values() if stripe.riser is not None and stripe.side == side]
    if len(whole) < 2:
        raise CalibrationError(f"pose {number + 1}: {len(whole)} of its {len(stripes)} stripes show base, riser and top: let the camera "
                               "and the laser see one upright face of the block, in two frames or more")
    to = np.array([1.0, 1.0, -1.0])  # of a line a x + b y + c = 0: its plane with the camera's centre has the normal (a, b, -c)
    along = [_unit(np.cross(stripe.base.line * to, stripe.top.line * to)) for stripe in shown.values()]
    feet = np.array([_meet(stripe.base, stripe.riser) for stripe in whole if stripe.riser is not None])
    edges = np.array([_meet(stripe.top, stripe.riser) for stripe in whole if stripe.riser is not None])
    of_feet, of_edges = (np.linalg.svd(rays)[2][-1] for rays in (feet, edges))
    edge = _unit(np.cross(of_feet, of_edges))
    normal = np.linalg.eigh(sum((np.outer(way, way) for way in along), len(along) * np.outer(edge, edge)))[1][:, 0]
    normal = normal if normal[2] > 0 else -normal
    across = _unit(np.cross(edge, normal))
    foot, top = feet @ across / (feet @ normal), edges @ across / (edges @ normal)
    distance = height_m * float((top * (top - foot)).sum() / np.maximum(((top - foot) ** 2).sum(), 1e-300))
    if not distance > height_m:
        raise CalibrationError(f"pose {number + 1}: its stripes are not those of an upright block on a flat base")
    base = -normal / distance
    lasers = {}
    for index, stripe in shown.items():
        points = np.concatenate([_on(segment, normal, -(distance - raised)) for segment, raised in
                                 ((stripe.base, 0.0), (stripe.top, height_m))])
        middle = points.mean(axis=0)
        way = np.linalg.svd(points - middle)[2][-1]
        lasers[index] = way / float(way @ middle)
    first, second = (way[0] for way in _in_plane((base / np.linalg.norm(base))[None]))
    place = -distance * float(np.median(foot))
    return np.array([*base, math.atan2(across @ second, across @ first), place, 0.0]), lasers


def _unit(vector: np.ndarray) -> np.ndarray:
    return np.asarray(vector / max(float(np.linalg.norm(vector)), 1e-300))


def _meet(one: Segment, other: Segment) -> np.ndarray:
    """Return the line of sight to where two lines meet, (x, y, -1)."""
    x, y, w = np.cross(one.line, other.line)
    return np.array([x / w, y / w, -1.0])


def _on(segment: Segment, normal: np.ndarray, offset: float) -> np.ndarray:
    """Return the ends of a line on the plane normal·X = offset, [2, 3]."""
    rays = np.hstack([segment.ends, -np.ones((2, 1))])
    return np.asarray(rays * (offset / (rays @ normal))[:, None])


def _plane(data: _Data, values: np.ndarray, residual: np.ndarray, covariance: np.ndarray, number: int, pixel: float) -> StepPlane:
    at = NUMBERS * data.poses + 3 * number
    plane, spread = values[at:at + 3], covariance[at:at + 3, at:at + 3]
    own = (data.laser == number) & (data.face < 2)
    rays = data.ends[own].reshape(-1, 3)
    depth = -1 / (rays @ plane) * rays[:, 2]
    # depth = 1 / (q·ray) along the ray: its relative error is that of q·ray
    relative = np.sqrt(np.einsum("ra,ab,rb->r", rays, spread, rays)) / np.abs(rays @ plane)
    length = float(np.linalg.norm(plane))
    turn = (np.eye(3) - np.outer(plane, plane) / length**2) / length
    tilt = math.degrees(math.sqrt(max(float(np.linalg.eigvalsh(turn @ spread @ turn.T)[-1]), 0.0)))
    lines = data.laser == number
    off = residual[:2 * len(data.face)].reshape(-1, 2)[lines] / data.weight[lines, None] / pixel
    middle = (rays * -depth[:, None] / rays[:, 2:]).mean(axis=0)
    place = math.sqrt(max(float(middle @ spread @ middle), 0.0)) / length
    return StepPlane(middle, plane / length, math.sqrt(float((off**2).mean())), place, tilt, float(relative.max()),
                     len(np.unique(data.pose[lines])))
