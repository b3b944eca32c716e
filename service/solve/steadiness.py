"""Whether the frames of a capture show the object at the same place, told by its texture.

Where a camera or a stage shakes, every reading is of another point: edges blur, and texture turns normals. A frame that is moved by d shows
albedo(p − d) in place of albedo(p), so that readings over expected ones are about 1 − ∇ln(albedo)·d (the linear step of Lucas and Kanade,
"An iterative image registration technique", IJCAI 1981). What errors of normals, highlights and bounced light add differs from place to
place, and a move does not: two halves of the places are asked apart.

A move that is linear in the direction of the light, d = M l, as of a slow drift while lamps burn row by row, leaves nothing of that:
normals take it up, whose slopes are off by Mᵀ∇ln(albedo). But such slopes are not those of a height: their curl is a mixture of the
second derivatives of ln(albedo), by which M is found, up to a move along the light's direction that is the same for both axes.
"""

from typing import NamedTuple

import numpy as np

from kernels.photometric.model.samples import evenly
from kernels.status import ESTIMATED
from service.solve.base.solution import Solution, SolveInput
from service.solve.squares import Square, squares
from stage.capture.point_lights import DistantLights

MOST_LIGHTS, LEAST_LIGHTS = 64, 8
PATCH = 8
"""Pixels along a side of the patches that belong to one half of the places."""
FLATTEST, STEEPEST, MOST_OFF = 0.03, 1.0, 0.4
"""Least step of ln albedo from pixel to pixel that is texture and no error of the model, the largest for which it is linear, and largest
difference of a ratio from 1 that is no shadow."""
LEAST_TEXTURE = 8.0
"""Least sum of squares of the steps in each half."""
LEAST_PX, LEAST_ALIKE = 0.1, 0.75
"""Least root mean square move, and correlation of the moves that both halves tell: 0.08 px and 0.6 at most of steady captures of texture,
real and path-traced, 0.15 px and 0.8 to 0.99 of those that shake by 0.4 px."""
LEAST_Z, SURE_DEGREES = 0.35, 8.0
"""Least z of a normal whose curl is compared, and largest σ of one at a place that tells: of metal edges neither normals nor albedo are
known, which is no texture then."""
MOST_CURL, LEAST_BEND, MOST_BEND = 0.3, 0.02, 0.6
"""Largest curl that is no edge; least second derivative of ln albedo that is texture, and the largest for which it is linear."""
LEAST_PLACES, ROUNDS = 150, 5
LEAST_DRIFT, SURE = 0.1, 5.0
"""Least move in pixels for a unit of the light's direction that both halves tell, and in its standard errors: 0.04 at most in both on
steady captures, real and path-traced, and 0.3 to 0.6 (`robust`) for a drift of a pixel."""


class Drift(NamedTuple):
    """A slow move along with the direction of the light."""

    px: float
    """The move while the light goes from one side to the other."""
    degrees: np.ndarray  # [pixels of the image] float32, error that it makes of normals

    @property
    def sentence(self) -> str:
        """What is said of it."""
        return (f"frames: what the camera sees moves by some {self.px:.1g} px while the light goes from one side to the other, as of a "
                "camera that sinks while lamps burn row by row: texture has turned the normals, and the layer sigma holds what that makes; "
                "fix camera and object, or align the images first")


class Shake(NamedTuple):
    """Moves from frame to frame."""

    px: float
    """Their root mean square, and rather too little."""
    degrees: float = 0.0
    """Error of normals that the fit has not left in sigma."""

    @property
    def sentence(self) -> str:
        """What is said of it."""
        return (f"frames: what the camera sees moves by {self.px:.2g} px or more from image to image, as of a camera held by hand or a "
                "stage that shakes: edges blur, and texture turns normals; fix both, or align the images first")


def find_motion(given: SolveInput, lights: DistantLights, solution: Solution) -> list[Shake | Drift]:
    """Return how the frames of a solve are moved against each other."""
    if not (lights.irradiance > 0).all():
        return []
    estimated = np.isin(solution.status, ESTIMATED).reshape(given.mask.shape)
    seen = list(squares(given, lights, solution.normal, estimated, most_lights=MOST_LIGHTS))
    found = _shake(lights.direction[evenly(len(lights.direction), MOST_LIGHTS)], solution, seen), _drift(lights, solution, estimated, seen)
    return [motion for motion in found if motion is not None]


def _shake(directions: np.ndarray, solution: Solution, seen: list[Square]) -> Shake | None:
    """Return how far frames are moved against each other, root mean square; None if they seem steady. `directions`: [lights, 3]."""
    count = len(directions)
    if count < LEAST_LIGHTS:
        return None
    matrix, vector = np.zeros((2, count, 2, 2)), np.zeros((2, count, 2))
    for square in seen:
        sure = (square.albedo > 0).all(axis=-1) & (solution.sigma[square.place] < SURE_DEGREES)
        grey = np.where(sure, square.albedo.mean(axis=-1), np.nan)
        down, right = np.gradient(np.log(grey))
        steps = np.stack([down, right], axis=-1)
        step = np.abs(steps).max(axis=-1)
        off = square.ratio.mean(axis=-1) - 1
        fits = np.isfinite(off) & (np.abs(off) < MOST_OFF) & (step > FLATTEST) & (step < STEEPEST)
        half = (np.indices(grey.shape) // PATCH).sum(axis=0) % 2
        for number in range(2):
            weight = (fits & (half == number)).astype(np.float64)
            told = np.where(weight.any(axis=0)[..., None], steps, 0)
            matrix[number] += np.einsum("lrc,rci,rcj->lij", weight, told, told)
            vector[number] -= np.einsum("lrc,rci->li", np.where(weight > 0, off, 0), told)
    if np.trace(matrix, axis1=2, axis2=3).mean(axis=1).min() < LEAST_TEXTURE:
        return None
    moves = np.linalg.solve(matrix + 1e-3 * np.eye(2), vector[..., None])[..., 0]
    linear = np.concatenate([directions[:, :2], np.ones((count, 1))], axis=1)
    moves -= linear @ np.linalg.lstsq(linear, moves.transpose(1, 0, 2).reshape(count, 4), rcond=None)[0].reshape(3, 2, 2).transpose(1, 0, 2)
    both, each = (moves[0] * moves[1]).sum(), np.sqrt((moves**2).sum(axis=(1, 2)).prod())
    px = float(np.sqrt(max(both, 0) / count))
    return Shake(px) if px >= LEAST_PX and both >= LEAST_ALIKE * each else None


def _drift(lights: DistantLights, solution: Solution, estimated: np.ndarray, seen: list[Square]) -> Drift | None:
    """Return the move along with the direction of the light that the curl of the slopes tells, or None."""
    curls: tuple[list[np.ndarray], list[np.ndarray]] = ([], [])
    bends: tuple[list[np.ndarray], list[np.ndarray]] = ([], [])
    for square in seen:
        sure = (square.albedo > 0).all(axis=-1) & (solution.sigma[square.place] < SURE_DEGREES)
        x, y, z = solution.normal[:, square.place]
        sure &= z > LEAST_Z
        texture = np.log(np.where(sure, square.albedo.mean(axis=-1), np.nan))
        down, right = np.gradient(texture)
        curl = np.gradient(np.where(sure, -x / np.where(sure, z, 1), np.nan), axis=0) - np.gradient(
            np.where(sure, y / np.where(sure, z, 1), np.nan), axis=1)
        bend = np.stack([np.gradient(right, axis=0), np.gradient(down, axis=0), np.gradient(right, axis=1)], axis=-1)
        most = np.abs(bend).max(axis=-1)  # NaN beside what is not known
        fits = (np.abs(curl) < MOST_CURL) & (most > LEAST_BEND) & (most < MOST_BEND)
        half = (np.indices(curl.shape) // PATCH).sum(axis=0) % 2
        for number in range(2):
            curls[number].append(curl[fits & (half == number)])
            bends[number].append(bend[fits & (half == number)])
    if min(sum(map(len, part)) for part in curls) < LEAST_PLACES:
        return None
    found, errors = np.stack([_fit(np.concatenate(curl), np.concatenate(bend)) for curl, bend in zip(curls, bends, strict=True)], axis=1)
    alike = (np.sign(found[0]) == np.sign(found[1])) & (np.abs(found).min(axis=0) >= np.maximum(LEAST_DRIFT, SURE * errors.max(axis=0)))
    if not alike.any():
        return None
    slope = float(np.abs(found.mean(axis=0))[alike].max())
    albedo = solution.albedo.astype(np.float32).mean(axis=0).reshape(estimated.shape)
    steps = np.gradient(np.log(np.where(estimated & (albedo > 0), albedo, np.nan)))
    degrees = np.nan_to_num(np.degrees(np.minimum(slope * np.hypot(*steps), 1.0))).reshape(-1)
    return Drift(slope * float(np.ptp(lights.direction[:, :2], axis=0).max()), degrees.astype(np.float32))


def _fit(curl: np.ndarray, bend: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the coefficients [3] of a robust fit of curls [n] by bends [n, 3], and their standard errors."""
    weight = np.ones(len(curl))
    for _ in range(ROUNDS):
        normal = bend.T @ (bend * weight[:, None]) + 1e-6 * np.eye(3)
        found = np.linalg.solve(normal, bend.T @ (weight * curl))
        spread = 1.5 * np.median(np.abs(curl - bend @ found)) + 1e-6
        weight = 1 / (1 + ((curl - bend @ found) / spread) ** 2)
    return found, spread * np.sqrt(np.diag(np.linalg.inv(normal)))
