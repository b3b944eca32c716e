"""Whether decoded columns and rows contradict the calibration, and by how much depths may then be off.

A point of a line of sight can only be imaged on one line of the projector, its epipolar line. Noise leaves decoded places to both sides of
it; a projector that is turned or zoomed otherwise than declared leaves them to one side over whole parts of the image. The turn, the zoom
and the direction of the baseline that explain the places best are fitted, and tell what the error along the line is, which no pixel shows.
"""

from typing import NamedTuple

import numpy as np

from stage.capture.projector import Projector

PRIOR = np.array([0.02, 0.02, 0.02, 0.03, 0.02, 0.02])
"""Usual errors of calibrations: turns about the projector's axes in rad, the part of the focal length, turns of the baseline in rad."""
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


class Contradiction(NamedTuple):
    """Evidence of systematic residuals against a calibration."""

    size_px: float
    """Distance of the decoded places from the epipolar lines that the fit explains, root mean square."""
    noise_px: float
    """Median distance that is left."""
    turn_deg: float
    """Angle by which the projector is turned from the declared pose."""
    zoom: float
    """Part by which the focal length is longer than declared."""
    sigma: np.ndarray  # [pixels] metres, by which depths may be off

    def sentence(self) -> str:
        """Return the warning."""
        return (f"projector: columns and rows contradict its calibration by {self.size_px:.2g} px ({self.noise_px:.2g} px are left by "
                f"noise), as if it were turned by {self.turn_deg:.2f}° from there and its focal_px {1 + self.zoom:.3f} times that: "
                "measure it again with relit calibrate procam; the standard deviations hold the error that this makes")


def _image(projector: Projector, q: np.ndarray) -> np.ndarray:
    """Return the place [2, pixels] in the projector of points [3, pixels] in its frame, from the principal point."""
    x, y = q[0] / q[2], q[1] / q[2]
    if projector.distortion is not None:
        x, y = projector.distortion.apply(x, y)
    return np.stack([projector.focal_px[0] * x, projector.focal_px[1] * y])


def _derivatives(projector: Projector, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return those of the places of points [pixels, 3] by the parameters, [6, 2, pixels], and by the inverse depth, [2, pixels]."""
    matrix = projector.projector_from_camera()
    shift = matrix[:, 3]
    q = matrix[:, :3] @ points.T + shift[:, None]
    across = np.linalg.svd(shift[None])[2][1:] * np.linalg.norm(shift)
    moves = [np.cross(axis, q.T).T for axis in np.eye(3)] + [np.broadcast_to(way[:, None], q.shape) for way in across]
    found = [(_image(projector, q + STEP * move) - _image(projector, q - STEP * move)) / (2 * STEP) for move in moves]
    found.insert(3, _image(projector, q))
    depth = -points[:, 2]
    move = depth * shift[:, None]  # of q times depth, which has the same image
    return np.stack(found), (_image(projector, q + STEP * move) - _image(projector, q - STEP * move)) / (2 * STEP)


def contradiction(projector: Projector, points: np.ndarray, places: np.ndarray, deviations: np.ndarray) -> Contradiction | None:
    """Return how decoded places contradict the calibration of a projector, None where noise explains them.
    `points`: [pixels, 3] metres, camera frame, as triangulated. `places`: [pixels, 2] decoded columns and rows, continuous projector
    pixels. `deviations`: [pixels, 2] their standard deviations."""
    if len(points) < ENOUGH:
        return None
    chosen = slice(None, None, -(-len(points) // MOST_PIXELS))
    by, way = _derivatives(projector, points[chosen])
    normal = np.stack([-way[1], way[0]]) / np.maximum(np.hypot(*way), 1e-12)
    off = (normal * (places[chosen] - projector.project(points[chosen])[0]).T).sum(axis=0)
    slopes = (by * normal).sum(axis=1).T * PRIOR  # [pixels, 6] of parameters in units of their usual errors
    own = np.sqrt(((normal * deviations[chosen].T)**2).sum(axis=0) + 1e-6)
    part, inverse = np.zeros(6), np.eye(6)
    for _ in range(ROUNDS):
        left = (off - slopes @ part) / own
        scale = max(1.0, float(np.median(np.abs(left))) / 0.6745)
        weight = 1 / (1 + (left / (3 * scale))**2) / (own * scale)**2 / ALIKE
        inverse = np.linalg.inv((slopes * weight[:, None]).T @ slopes + np.eye(6))
        part = inverse @ ((slopes * weight[:, None]).T @ off)
    left = off - slopes @ part
    size = float(np.sqrt(np.mean((slopes @ part)**2)))
    gain = float((weight * (off**2 - left**2)).sum())
    if size < LEAST_PX or gain < LEAST_GAIN:
        return None
    by, way = _derivatives(projector, points)
    trust = 1 / np.maximum(deviations.T, 1e-3)**2
    depth = -points[:, 2]
    moved = depth**2 * (by * trust * way).sum(axis=1) / (trust * way**2).sum(axis=0) * PRIOR[:, None]  # [6, pixels] metres
    spread = np.einsum("ip,ij,jp->p", moved, inverse, moved)
    turned = float(np.degrees(np.linalg.norm((part * PRIOR)[:3])))
    return Contradiction(size, float(np.median(np.abs(left))), turned, float(part[3] * PRIOR[3]), np.sqrt((part @ moved)**2 + spread))
