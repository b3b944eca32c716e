"""Whether what the camera sees slides slowly from the first frame to the last, as of a stand that sinks or a tripod that settles.

Each frame is registered to what the solved normals and albedo predict of it, by the linear step of Lucas and Kanade ("An iterative image
registration technique", IJCAI 1981) on slightly blurred images, outlines before a dark ground included. Highlights, shadows and a wrong
albedo move such a step too, but along with the light and not with the time; what is linear in the light's direction is taken out of both.
"""

from typing import NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter

from kernels.photometric.model.samples import evenly
from kernels.status import ESTIMATED
from service.solve.base.solution import Solution, SolveInput
from service.solve.squares import SIDE
from stage.capture.point_lights import DistantLights

MOST_LIGHTS, LEAST_LIGHTS, MOST_SQUARES, LEAST_SOLVED = 48, 10, 24, 64
"""Frames that are looked at, squares of the image, and the least number of solved pixels of these."""
BLUR = 1.0
"""In pixels, of what is compared."""
QUARTERS = 4
LEAST_PART = 0.02
"""Least predicted reading, as a part of the largest of its square, of places that are compared: beyond outlines it is none."""
ROUNDS, OUTLIER = 4, 1.5
"""Rounds of robust weights; the residual, in medians of all, that counts half."""
LEAST_FREE, TINY = 0.02, 1e-12
"""Least part of the course of time that is not along with the light; what keeps divisions finite where nothing is lit."""
LEAST_PX, LEAST_SURE, LEAST_ALIKE = 0.5, 5.0, 3
"""Least move from the first frame to the last, in pixels and in standard errors of its trend, and how many quarters of the object tell at
least half of it. Of 125 path-traced captures that are steady, and 56 under lights that are declared wrongly, none that seems
to move by 0.3 px or more has more than 3.4 standard errors, of real ones a glossy ball under `lambert` 3.9, told by two; of 91 that
slide by 3.3 px 67 have 5."""


class Slide(NamedTuple):
    """A steady move from the first frame to the last."""

    px: float
    degrees: np.ndarray  # [pixels of the image] float32, error that it makes of normals

    @property
    def sentence(self) -> str:
        """What is said of it."""
        return (f"frames: what the camera sees moves steadily, by some {self.px:.2g} px from the first image to the last, as of a stand "
                "that sinks or a tripod that settles: edges blur, texture and outlines turn the normals, and the layer sigma holds what "
                "that makes; fix camera and object, or align the images first")


def find_slide(given: SolveInput, lights: DistantLights, solution: Solution) -> Slide | None:
    """Return how the frames of a solve slide, if they do. The frames are taken to be in the order in which they were taken."""
    chosen = evenly(len(lights.direction), MOST_LIGHTS)
    if len(chosen) < LEAST_LIGHTS:
        return None
    estimated = np.isin(solution.status, ESTIMATED).reshape(given.mask.shape)
    directions, time = lights.direction[chosen], chosen / (len(lights.direction) - 1) - 0.5
    moves = _moves(given, lights.irradiance[chosen].mean(axis=-1) / np.pi, directions, solution, estimated, chosen)
    if moves is None:
        return None
    linear = np.concatenate([np.ones((len(chosen), 1)), directions[:, :2]], axis=1)
    time_left, moves_left = (values - linear @ np.linalg.lstsq(linear, values, rcond=None)[0] for values in (
        time, moves.transpose(1, 0, 2).reshape(len(chosen), 2 * QUARTERS)))
    length = time_left @ time_left
    if length < LEAST_FREE * (time @ time):
        return None
    trend = time_left @ moves_left / length
    spread = np.square(moves_left - time_left[:, None] * trend).sum(axis=0) / (len(chosen) - 4) / length
    trend, weight = trend.reshape(QUARTERS, 2), 1 / (spread.reshape(QUARTERS, 2).mean(axis=1) + TINY)
    move = weight @ trend / weight.sum()
    px = float(np.hypot(*move))
    if px < max(LEAST_PX, LEAST_SURE * np.sqrt(QUARTERS / weight.sum())) or (trend @ move > 0.5 * px**2).sum() < LEAST_ALIKE:
        return None
    every = np.arange(estimated.size, dtype=np.int32).reshape(estimated.shape)
    return Slide(px, _error(directions, time, _reflected(solution, estimated, every), move))


def _reflected(solution: Solution, estimated: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Return normals times albedo at row-major positions [rows, cols] of the image: [3, rows, cols] float32, 0 where none is estimated."""
    values = solution.albedo[:, place].astype(np.float32).mean(axis=0) * solution.normal[:, place].astype(np.float32)
    return np.where(estimated.reshape(-1)[place], np.nan_to_num(values, posinf=0, neginf=0), 0)


def _moves(given: SolveInput, strength: np.ndarray, directions: np.ndarray, solution: Solution, estimated: np.ndarray,
           chosen: np.ndarray) -> np.ndarray | None:
    """Return how far each frame is moved, down and right, against what is predicted of it, [quarters, lights, 2], told by each quarter of
    the object by itself; None where one says nothing."""
    height, width = estimated.shape
    corners = [(row, col) for row in range(0, height, SIDE) for col in range(0, width, SIDE)
               if estimated[row : row + SIDE, col : col + SIDE].sum() > LEAST_SOLVED]
    if not corners:
        return None
    middle_row, middle_col = (np.median(numbers) for numbers in np.nonzero(estimated))
    predicted_steps, rests, quarters = [], [], []
    for row, col in (corners[number] for number in evenly(len(corners), MOST_SQUARES)):
        place = np.arange(row, min(row + SIDE, height))[:, None] * width + np.arange(col, min(col + SIDE, width))
        seen = given.stack.pick_radiance(place.reshape(-1))[0][chosen].mean(axis=-1).reshape(-1, *place.shape)
        shading = np.maximum(np.einsum("lk,krc->lrc", directions, _reflected(solution, estimated, place)), 0)
        predicted, blurred = (gaussian_filter(values, (0, BLUR, BLUR)) for values in (strength[:, None, None] * shading, seen))
        brightest = predicted.max(axis=0)
        near = brightest > LEAST_PART * brightest.max()
        down, right = np.gradient(predicted, axis=(1, 2))
        predicted_steps.append(np.stack([predicted, -down, -right], axis=-1)[:, near])
        rests.append((blurred - predicted)[:, near])
        quarters.append((2 * (place // width > middle_row) + (place % width > middle_col))[near])
    steps, rest, quarter = np.concatenate(predicted_steps, axis=1), np.concatenate(rests, axis=1), np.concatenate(quarters)
    if len(np.unique(quarter)) < QUARTERS:
        return None
    return np.stack([_registered(steps[:, quarter == number], rest[:, quarter == number]) for number in range(QUARTERS)])


def _registered(steps: np.ndarray, rest: np.ndarray) -> np.ndarray:
    """Return the moves [lights, 2] whose steps [lights, n, 3], of brightness, down and right, leave least of what is not predicted [lights,
    n], robustly."""
    weight = np.ones_like(rest)
    least = 1e-3 * steps[..., 0].max(axis=1, keepdims=True, initial=1e-30)
    for _ in range(ROUNDS):
        weighted = steps * weight[..., None]
        normal = weighted.swapaxes(1, 2) @ steps
        normal += (1e-9 * np.trace(normal, axis1=1, axis2=2)[:, None, None] + TINY) * np.eye(3)
        found = np.linalg.solve(normal, weighted.swapaxes(1, 2) @ rest[..., None])
        residual = np.abs(rest - (steps @ found)[..., 0])
        weight = 1 / (1 + (residual / (OUTLIER * np.median(residual, axis=1, keepdims=True) + least)) ** 2)
    return found[:, 1:, 0]


def _error(directions: np.ndarray, time: np.ndarray, images: np.ndarray, move: np.ndarray) -> np.ndarray:
    """Return the angles by which a move turns normals, [pixels] float32 degrees: least squares by readings that each are of a place moved
    by its time, and the half move by which the maps are off at the first image and the last.
    `images`: [3, rows, cols] normals times albedo."""
    changes = np.stack([np.tensordot(move, np.gradient(image), axes=1) for image in images])
    turned = np.tensordot(np.linalg.pinv(directions) @ (time[:, None] * directions), changes, axes=1)
    length = np.maximum(np.linalg.norm(images, axis=0), 1e-30)
    unit = images / length
    parts = [values - (values * unit).sum(axis=0) * unit for values in (turned, changes / 2)]
    across = np.sqrt(sum(np.square(part).sum(axis=0) for part in parts)) / length
    return np.degrees(np.arctan(across)).astype(np.float32).reshape(-1)
