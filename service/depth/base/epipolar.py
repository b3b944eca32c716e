"""Whether the places at which a projector or another camera sees points contradict its calibration, and by how much depths may be off.

A point of a line of sight can only be imaged on one line of the second view, its epipolar line. Noise leaves places to both sides of it; a
view that is turned or zoomed otherwise than declared leaves them to one side over whole parts of the image. The turn, the zoom and the
direction of the baseline that explain the places best are fitted, and tell what the error along the line is, which no pixel shows.

How far off calibrations usually are is not known beforehand: one factor for all parameters is fitted with them, so that small
contradictions leave small errors open.

Source: MacKay, "Bayesian interpolation", Neural Computation 4, 1992, for the factor.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import numpy as np
from scipy.spatial.transform import Rotation

from stage.capture.camera import Camera
from stage.capture.projector import Projector
from stage.spread import between_blocks
from stage.transforms import OPENCV_FROM_CAMERA

PRIOR = np.array([0.02, 0.02, 0.02, 0.03, 0.02, 0.02, 0.015, 0.015, 0.015, 0.015, 0.03])
"""Errors of bad calibrations, whose ratios are those of good ones: turns about the view's axes in rad, the part of the focal length, turns
of the baseline in rad, and places of the principal point as parts of the focal length; the last two of the first camera too."""
VIEW = 8
"""Number of the first parameters, which are those of the view and fitted together."""
FOCALS, ASIDE = ((3,), (10,)), ((6, 7), (8, 9))
"""Parameters that are the focal lengths, and the places of the principal points, of the view and of the camera: what one of them may be if
nothing is believed of it is asked for alone, as it may be typed wrongly."""
ALONE, ALONE_LEAST = 0.7, 0.005
"""Factor of the errors of all other parameters, over that without this, below which a principal point is said to be aside, and the least
factor that is told from none. Of 240 simulated captures with one aside by 2 to 10 % of the width, most with other errors beside, 7 %
have more than a twentieth of the pixels beyond five σ, 39 % without this; right ones are as before."""
ALONE_ROUNDS = 300
"""Number of steps by which such a factor is found: it is as small as a hundredth of the first guess."""
ANYTHING = 20.0**-2
"""Weight of a parameter that may be anything: twenty errors of bad calibrations, which puts a principal point anywhere in the image."""
LARGEST = 3.0
"""Largest parameter of a view that may be what was calibrated, in errors of bad calibrations."""
UNSEEN = 3.0
"""How many times as large as the factor says errors may be, because those that no line shows may be larger than those that lines show."""
STEP = 1e-4
"""Change of a parameter by which derivatives are taken."""
MOST_POINTS = 20_000
"""Number of points, evenly spread, that are fitted."""
ENOUGH, OF_THEIR_OWN = 33, 10
"""Number of points below which nothing is concluded, and of those whose errors are their own: no right one of 150 small captures of 90 to
900 points was contradicted."""
LEAST_GAIN = 50.0
"""Least drop of the squared residuals over their variance that tells a contradiction."""
LEAST_SQUARE = 150.0
"""Least square of the parameters over their covariance with that of blocks, where not all of them are fitted: cameras that boards have
calibrated leave 10 to 125, one that was turned by 0.05° since 200, and by 0.2° 2000 and more."""
HELD = 1e12
"""Weight of what holds a parameter that is not fitted."""
ROUNDS = 24
"""Number of fits from which the factor of the errors is found, each with the weights of Cauchy and the factor that the one before gives."""
LAST_ROUNDS = 6
"""Number of fits with that factor."""
REFINEMENTS = 3
"""Largest number of times that a view is refined, each by what is triangulated with the one before."""

Found = TypeVar("Found")


class Contradiction(NamedTuple):
    """Evidence of systematic residuals against a calibration."""

    size_px: float
    """Distance of the places from the epipolar lines that the fit explains, root mean square."""
    noise_px: float
    """Median distance that is left."""
    declared: Projector
    """The view as it was given."""
    projector: Projector
    """The view that explains the places best, of those that may be what was calibrated."""
    part: np.ndarray  # [11] changes of the parameters from the declared view to the one that was found, in units of PRIOR
    covariance: np.ndarray  # [11, 11] of these changes
    whole: np.ndarray  # [11] changes from the view as it was given
    aside: dict[int, tuple[np.ndarray, np.ndarray]]
    """The same changes and covariance with a principal point that may be anywhere, 0: of the view, 1: of the camera, the likeliest first,
    where the others are much smaller then, and no focal length does that."""

    @property
    def plausible(self) -> bool:
        """Return whether a view may be calibrated so badly; otherwise something else is wrong."""
        return bool(np.abs(self.whole).max() <= LARGEST)

    def moved(self, points: np.ndarray, deviations: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Return by how much depths differ with the view that was found, and their standard deviation with it, which holds what principal
        points aside make, each [points] metres.
        `points`: [points, 3] metres, camera frame, as triangulated. `deviations`: [points, 2] of the places from which they were; None:
        alike."""
        by, way = _derivatives(self.declared, points)
        trust = 1.0 if deviations is None else 1 / np.maximum(deviations.T, 1e-3)**2
        depths = points[:, 2]**2 * (by * trust * way).sum(axis=1) / (trust * way**2).sum(axis=0) * PRIOR[:, None]
        shifts, variances = zip(*((part @ depths, np.einsum("ip,ij,jp->p", depths, covariance, depths))
                                  for part, covariance in ((self.part, self.covariance), *self.aside.values())), strict=True)
        return shifts[0], np.sqrt(np.max(np.square(shifts) + variances, axis=0) - shifts[0]**2)

    def error(self, points: np.ndarray, deviations: np.ndarray | None = None, *, given: Projector) -> np.ndarray:
        """Return by how much depths that are those of the declared view may be off, [points] metres; see `moved`.
        `given`: the view as it was given. If that was refined to the declared one, the baseline may be as much longer as it was turned,
        which no line shows."""
        ways = [np.array(each.camera_from_projector)[:3, 3] for each in (given, self.declared)]
        return np.hypot(np.hypot(*self.moved(points, deviations)),
                        points[:, 2] * np.linalg.norm(ways[1] - ways[0]) / np.linalg.norm(ways[0]))


def difference(declared: Projector, found: Projector) -> str:
    """Return how a view that was found differs from the declared one, for a sentence."""
    poses = [np.array(each.camera_from_projector)[:3, :3] for each in (declared, found)]
    turn = float(np.degrees(Rotation.from_matrix(poses[0].T @ poses[1]).magnitude()))
    return f"as if it were turned by {turn:.2f}° from there and its focal_px {found.focal_px[0] / declared.focal_px[0]:.3f} times that"


def places_aside(found: Contradiction, view: Projector, camera: Camera, names: tuple[str, str] = ("projector", "camera")) -> str:
    """Return where the principal points are that explain a contradiction, for a sentence. `names`: of the fields of view and camera."""
    said = []
    for device, (part, covariance) in found.aside.items():
        each, rows = (view, camera)[device], list(ASIDE[device])
        middle, pixels = each.principal_px or np.array(each.resolution) / 2, PRIOR[6] * np.array(each.focal_px)
        places, spreads = middle + part[rows] * pixels, np.sqrt(np.diag(covariance))[rows] * pixels
        told = ", ".join(f"{place:.4g} ± {spread:.2g}" for place, spread in zip(places, spreads, strict=True))
        said.append(f"{names[device]}.principal_px were [{told}]")
    return "about as if " + " or ".join(said)


def view_facts(view: Projector, name: str, pose: object) -> dict[str, Any]:
    """Return a view that was refined as the report has it: its lens, and its place under the name that a manifest gives it."""
    return {"focal_px": view.focal_px, "principal_px": view.principal_px, name: pose}


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
    """Return those of the places of points [pixels, 3] by the parameters, [11, 2, pixels], and by the inverse depth, [2, pixels]."""
    matrix = projector.projector_from_camera()
    shift = matrix[:, 3]
    q = matrix[:, :3] @ points.T + shift[:, None]
    x, y, z = points.T
    rays = np.array([[z, 0 * z, 0 * z], [0 * z, -z, 0 * z], [-x, -y, 0 * z]])  # of the camera
    moves = [np.cross(axis, q.T).T for axis in np.eye(3)] + [np.broadcast_to(way[:, None], q.shape) for way in _across(shift)]
    moves += list(matrix[:, :3] @ rays)
    found = [(_image(projector, q + STEP * move) - _image(projector, q - STEP * move)) / (2 * STEP) for move in moves]
    found.insert(3, _image(projector, q))
    found[6:6] = [np.broadcast_to(side[:, None], found[3].shape) for side in np.diag(projector.focal_px)]
    depth = -points[:, 2]
    move = depth * shift[:, None]  # of q times depth, which has the same image
    return np.stack(found), (_image(projector, q + STEP * move) - _image(projector, q - STEP * move)) / (2 * STEP)


def _turned(projector: Projector, part: np.ndarray) -> Projector:
    """Return a projector whose parameters are changed, [11] as PRIOR has them."""
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
        "principal_px": [place + move * focal for place, move, focal in zip(middle, part[6:8], projector.focal_px, strict=True)]})


def contradiction(projector: Projector, points: np.ndarray, places: np.ndarray, deviations: np.ndarray, *, least_px: float,
                  least_part: float = 0.0, alike: float = 1.0, free: int = VIEW, typed: bool = True,
                  before: Contradiction | None = None) -> Contradiction | None:
    """Return how the places of points contradict the calibration of a view, None where noise explains them.

    Args:
        projector: the view, a projector or another camera.
        points: [points, 3] metres, camera frame, as triangulated.
        places: [points, 2] measured columns and rows in the view, continuous pixels.
        deviations: [points, 2] their standard deviations.
        least_px: least systematic distance from the epipolar lines that is one.
        least_part: the same as a part of the median distance that the fit leaves.
        alike: number of neighbours whose errors are counted as one.
        free: number of the first parameters that are fitted; the others are as they were given.
        typed: whether a principal point may be typed wrongly, which a turn about the same axis looks like.
        before: the contradiction by which the view was found. How far the view is from the one that was given then counts, and what the
            fit leaves open, however well it explains the places.
    """
    if len(points) < max(ENOUGH, OF_THEIR_OWN * alike):
        return None
    chosen = slice(None, None, -(-len(points) // MOST_POINTS))
    by, way = _derivatives(projector, points[chosen])
    normal = np.stack([-way[1], way[0]]) / np.maximum(np.hypot(*way), 1e-12)
    off = (normal * (places[chosen] - projector.project(points[chosen])[0]).T).sum(axis=0)
    every = (by * normal).sum(axis=1).T * PRIOR  # [points, 11] of parameters in units of PRIOR
    own = np.sqrt(((normal * deviations[chosen].T)**2).sum(axis=0) + 1e-6)
    part, factor = np.zeros(len(PRIOR)), 1.0
    so_far = np.zeros(len(PRIOR)) if before is None else before.whole
    held = np.arange(len(PRIOR)) >= free
    slopes = np.where(held, 0, every)

    def fitted() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the parameters, their covariance, and the weights of the points that the parameters before gave."""
        left = (off - slopes @ part) / own
        scale = max(1.0, float(np.median(np.abs(left))) / 0.6745)
        weight = 1 / (1 + (left / (3 * scale))**2) / (own * scale)**2 / alike
        covariance = np.linalg.inv((slopes * weight[:, None]).T @ slopes + np.diag(np.where(held, HELD, 1 / factor**2)))
        return covariance @ ((slopes * weight[:, None]).T @ off - so_far / factor**2), covariance, weight

    for _ in range(ROUNDS):
        part, covariance, _ = fitted()
        factor = float(np.sqrt(((so_far + part)**2 + np.diag(covariance))[:free].mean()))
    factor *= UNSEEN
    for _ in range(LAST_ROUNDS):
        part, covariance, weight = fitted()
    left = off - slopes @ part
    size, noise = float(np.sqrt(np.mean((slopes @ part)**2))), float(np.median(np.abs(left)))
    gain = float((weight * (off**2 - left**2)).sum())
    sure = True
    if free < VIEW:  # others may be wrong too, as far as whole blocks of the image say
        ahead = points[chosen, :2] / points[chosen, 2:]
        covariance = covariance + between_blocks(covariance, slopes * (weight * left)[:, None], *ahead.T)
        sure = float(part[:free] @ np.linalg.solve(covariance[:free, :free], part[:free])) > LEAST_SQUARE
    if before is None and (size < max(least_px, least_part * noise) or gain < LEAST_GAIN or not sure):
        return None
    found = _turned(projector, np.clip(part, -LARGEST, LARGEST) * PRIOR)
    aside = {} if before is not None or not typed else _aside((every * weight[:, None]).T @ every, (every * weight[:, None]).T @ off)
    return Contradiction(size, noise, projector, found, part, covariance, so_far + part, aside)


def _aside(matrix: np.ndarray, right: np.ndarray) -> dict[int, tuple[np.ndarray, np.ndarray]]:
    """Return the principal points that may be aside as `Contradiction` has them; of the normal equations, [11, 11] and [11]."""
    def fitted(alone: tuple[int, ...]) -> tuple[float, np.ndarray, np.ndarray]:
        """Return the factor of the errors of all parameters but some, which may be anything, the parameters, and their covariance."""
        others = np.setdiff1d(np.arange(VIEW), alone)
        believed = np.full(len(PRIOR), HELD)
        believed[list(alone)] = ANYTHING
        factor = 1.0
        for left in reversed(range(ALONE_ROUNDS)):
            believed[others] = 1 / (factor if left else UNSEEN * factor)**2
            covariance = np.linalg.inv(matrix + np.diag(believed))
            part = covariance @ right
            if left:
                factor = max(float(np.sqrt((part**2 + np.diag(covariance))[others].mean())), ALONE_LEAST)
        return factor, part, covariance

    least = min(fitted(one)[0] for one in FOCALS)
    found = sorted(((*fitted(one), device) for device, one in enumerate(ASIDE)), key=lambda each: each[0])
    together = fitted(())[0]
    return {device: (part, covariance) for factor, part, covariance, device in found if factor < min(least, ALONE * together)}


def settled(view: Projector, measure: Callable[[Projector, Contradiction | None], tuple[Found, Contradiction | None]], *,
            refine: bool) -> tuple[Projector, Found, Contradiction | None]:
    """Measure with a view as it was given, and, where this is asked for, with the one that the places tell, again and again.

    Args:
        view: as it was given.
        measure: what measures with a view, and returns what it found and how that contradicts the view. It gets the view, and the
            contradiction by which it was found, None for the view as it was given.
        refine: whether this is asked for.

    Returns:
        The view, what was measured with it, and how that contradicts it still.
    """
    before: Contradiction | None = None
    for left in reversed(range(REFINEMENTS + 1 if refine else 1)):
        found, contradicted = measure(view, before)
        if contradicted is None or not contradicted.plausible or contradicted.aside or not left:
            break
        view, before = contradicted.projector, contradicted
    return view, found, contradicted
