"""Whether decoded columns and rows contradict the calibration, and by how much depths may then be off.

A point of a line of sight can only be imaged on one line of the projector, its epipolar line. Noise leaves decoded places to both sides of
it; a projector that is turned or zoomed otherwise than declared leaves them to one side over whole parts of the image. The turn, the zoom
and the direction of the baseline that explain the places best are fitted, and tell what the error along the line is, which no pixel shows.
"""

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from kernels.status import SOLVED
from service.depth.base.solution import DepthSolution
from service.depth.patterns.coordinates import AxisMaps
from stage.capture.camera import Camera
from stage.capture.projector import Projector
from stage.transforms import OPENCV_FROM_CAMERA

PRIOR = np.array([0.02, 0.02, 0.02, 0.03, 0.02, 0.02, 0.015, 0.015])
"""Usual errors of calibrations: turns about the projector's axes in rad, the part of the focal length, turns of the baseline in rad, and
places of the principal point as parts of the focal length."""
STEP = 1e-4
"""Change of a parameter by which derivatives are taken."""
MOST_PIXELS = 20_000
"""Number of pixels, evenly spread, that are fitted."""
ENOUGH = 300
"""Number of pixels below which nothing is concluded."""
ALIKE = 9.0
"""Number of neighbours whose errors are counted as one, as those of one stripe are."""
LEAST_PX, LEAST_GAIN = 0.1, 50.0
"""Least systematic distance from the epipolar lines that is one, which good calibrations and uneven stripes do not reach, and the least
drop of the squared residuals over their variance."""
ROUNDS = 6
"""Number of fits, each with the weights of Cauchy that the one before gives."""
REFINEMENTS = 3
"""Largest number of times that a projector is refined, each by what is triangulated with the one before."""


class Contradiction(NamedTuple):
    """Evidence of systematic residuals against a calibration."""

    size_px: float
    """Distance of the decoded places from the epipolar lines that the fit explains, root mean square."""
    noise_px: float
    """Median distance that is left."""
    projector: Projector
    """The projector that explains the places best."""
    moved: np.ndarray  # [pixels] metres, by which depths differ with it
    spread: np.ndarray  # [pixels] metres, standard deviation of depths with it

    @property
    def sigma(self) -> np.ndarray:
        """Return by how much depths may be off with the projector as it was given, [pixels] metres."""
        return np.hypot(self.moved, self.spread)

    def sentence(self, declared: Projector, *, refined: bool = False) -> str:
        """Return the warning. `refined`: depths are those of the projector that was found."""
        poses = [np.array(each.camera_from_projector)[:3, :3] for each in (declared, self.projector)]
        turn = float(np.degrees(Rotation.from_matrix(poses[0].T @ poses[1]).magnitude()))
        found = (f"as if it were turned by {turn:.2f}° from there and its focal_px "
                 f"{self.projector.focal_px[0] / declared.focal_px[0]:.3f} times that")
        if refined:
            return (f"projector: columns and rows contradict its calibration, {found}: depths are those of a projector that is "
                    f"({self.noise_px:.2g} px are left), which found.refined_projector in report.json holds, and the standard deviations "
                    "hold what this leaves open")
        return (f"projector: columns and rows contradict its calibration by {self.size_px:.2g} px ({self.noise_px:.2g} px are left by "
                f"noise), {found}: measure it again with relit calibrate procam, or take it as found (--refine-projector); the standard "
                "deviations hold the error that this makes")


def _image(projector: Projector, q: np.ndarray) -> np.ndarray:
    """Return the place [2, pixels] in the projector of points [3, pixels] in its frame, from the principal point."""
    x, y = q[0] / q[2], q[1] / q[2]
    if projector.distortion is not None:
        x, y = projector.distortion.apply(x, y)
    return np.stack([projector.focal_px[0] * x, projector.focal_px[1] * y])


def _across(shift: np.ndarray) -> np.ndarray:
    """Return two vectors [2, 3] as long as a baseline, at right angles to it and to each other."""
    return np.asarray(np.linalg.svd(shift[None])[2][1:] * np.linalg.norm(shift))


def _derivatives(projector: Projector, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return those of the places of points [pixels, 3] by the parameters, [8, 2, pixels], and by the inverse depth, [2, pixels]."""
    matrix = projector.projector_from_camera()
    shift = matrix[:, 3]
    q = matrix[:, :3] @ points.T + shift[:, None]
    moves = [np.cross(axis, q.T).T for axis in np.eye(3)] + [np.broadcast_to(way[:, None], q.shape) for way in _across(shift)]
    found = [(_image(projector, q + STEP * move) - _image(projector, q - STEP * move)) / (2 * STEP) for move in moves]
    found.insert(3, _image(projector, q))
    found += [np.broadcast_to(side[:, None], found[3].shape) for side in np.diag(projector.focal_px)]
    depth = -points[:, 2]
    move = depth * shift[:, None]  # of q times depth, which has the same image
    return np.stack(found), (_image(projector, q + STEP * move) - _image(projector, q - STEP * move)) / (2 * STEP)


def _turned(projector: Projector, part: np.ndarray) -> Projector:
    """Return a projector whose parameters are changed, [8] as PRIOR has them."""
    matrix = projector.projector_from_camera()
    turn = Rotation.from_rotvec(part[:3]).as_matrix()
    shift = turn @ matrix[:, 3] + part[4:6] @ _across(matrix[:, 3])
    shift *= np.linalg.norm(matrix[:, 3]) / np.linalg.norm(shift)
    rotation = turn @ matrix[:, :3]
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation.T @ OPENCV_FROM_CAMERA, -rotation.T @ shift
    middle = projector.principal_px or (projector.resolution[0] / 2, projector.resolution[1] / 2)
    return Projector.model_validate({
        **projector.model_dump(), "camera_from_projector": pose.tolist(), "focal_px": [one * (1 + part[3]) for one in projector.focal_px],
        "principal_px": [place + move * focal for place, move, focal in zip(middle, part[6:], projector.focal_px, strict=True)]})


def contradiction(projector: Projector, points: np.ndarray, places: np.ndarray, deviations: np.ndarray, *,
                  refined: bool = False) -> Contradiction | None:
    """Return how decoded places contradict the calibration of a projector, None where noise explains them.
    `points`: [pixels, 3] metres, camera frame, as triangulated. `places`: [pixels, 2] decoded columns and rows, continuous projector
    pixels. `deviations`: [pixels, 2] their standard deviations. `refined`: the projector was fitted to such places, so that what the fit
    leaves open counts however well it explains them."""
    if len(points) < ENOUGH:
        return None
    chosen = slice(None, None, -(-len(points) // MOST_PIXELS))
    by, way = _derivatives(projector, points[chosen])
    normal = np.stack([-way[1], way[0]]) / np.maximum(np.hypot(*way), 1e-12)
    off = (normal * (places[chosen] - projector.project(points[chosen])[0]).T).sum(axis=0)
    slopes = (by * normal).sum(axis=1).T * PRIOR  # [pixels, 8] of parameters in units of their usual errors
    own = np.sqrt(((normal * deviations[chosen].T)**2).sum(axis=0) + 1e-6)
    part, inverse = np.zeros(len(PRIOR)), np.eye(len(PRIOR))
    for _ in range(ROUNDS):
        left = (off - slopes @ part) / own
        scale = max(1.0, float(np.median(np.abs(left))) / 0.6745)
        weight = 1 / (1 + (left / (3 * scale))**2) / (own * scale)**2 / ALIKE
        inverse = np.linalg.inv((slopes * weight[:, None]).T @ slopes + np.eye(len(PRIOR)))
        part = inverse @ ((slopes * weight[:, None]).T @ off)
    left = off - slopes @ part
    size = float(np.sqrt(np.mean((slopes @ part)**2)))
    gain = float((weight * (off**2 - left**2)).sum())
    if not refined and (size < LEAST_PX or gain < LEAST_GAIN):
        return None
    by, way = _derivatives(projector, points)
    trust = 1 / np.maximum(deviations.T, 1e-3)**2
    depth = -points[:, 2]
    moved = depth**2 * (by * trust * way).sum(axis=1) / (trust * way**2).sum(axis=0) * PRIOR[:, None]  # [8, pixels] metres
    spread = np.einsum("ip,ij,jp->p", moved, inverse, moved)
    return Contradiction(size, float(np.median(np.abs(left))), _turned(projector, part * PRIOR), part @ moved, np.sqrt(spread))


def contradicted(solution: DepthSolution, u: AxisMaps, v: AxisMaps, camera: Camera, projector: Projector, *,
                 refined: bool = False) -> tuple[Contradiction, np.ndarray] | None:
    """Return how columns and rows contradict a projector, with the pixels that tell, [rows, cols] bool; None where they do not."""
    judged = np.isin(solution.status, SOLVED) & u.solved & v.solved
    found = contradiction(projector, camera.points(-solution.depth)[judged], np.stack([u.coordinate[judged], v.coordinate[judged]], axis=1),
                          np.stack([u.sigma[judged], v.sigma[judged]], axis=1), refined=refined)
    return None if found is None else (found, judged)


def widen(solution: DepthSolution, found: Contradiction, judged: np.ndarray, declared: Projector, *, refined: bool = False) -> None:
    """Add to σ by how much depths may be off where columns and rows contradict the calibration, and say so."""
    off = found.spread
    if refined:  # the baseline may be as much longer as it is turned, which no line shows
        ways = [np.array(each.camera_from_projector)[:3, 3] for each in (declared, found.projector)]
        off = np.hypot(off, solution.depth[judged] * np.linalg.norm(ways[1] - ways[0]) / np.linalg.norm(ways[0]))
    else:
        off = found.sigma
    assert solution.sigma is not None
    more = np.where(np.isin(solution.status, SOLVED), float(np.median(off)), 0.0)
    more[judged] = off
    solution.sigma[:] = np.hypot(solution.sigma, more)
    solution.warnings.append(found.sentence(declared, refined=refined))
    solution.facts["contradiction_px"] = float(f"{found.size_px:.3g}")
    if refined:
        projector = found.projector.model_dump(mode="json")
        solution.facts["refined_projector"] = {name: projector[name] for name in ("focal_px", "principal_px", "camera_from_projector")}
