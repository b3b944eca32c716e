"""Whether the frames of a capture show the object at the same place, told by its texture.

Where a camera or a stage shakes, every reading is of another point: edges blur, and texture turns normals. A frame that is moved by d shows
albedo(p − d) in place of albedo(p), so that readings over expected ones are about 1 − ∇ln(albedo)·d (the linear step of Lucas and Kanade,
"An iterative image registration technique", IJCAI 1981). What errors of normals, highlights and bounced light add differs from place to
place, and a move does not: two halves of the places are asked apart.

A move that is linear in the direction of the light, such as a slow drift while lamps burn row by row, turns normals as texture asks, and
nothing is left to tell it by.
"""

import numpy as np

from kernels.photometric.model.samples import evenly
from kernels.status import ESTIMATED
from service.solve.base.solution import Solution, SolveInput
from service.solve.squares import squares
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


def find_moves(given: SolveInput, lights: DistantLights, solution: Solution) -> float | None:
    """Return how far frames are moved against each other, root mean square in pixels and rather too little; None if they seem steady."""
    if len(lights.direction) < LEAST_LIGHTS or not (lights.irradiance > 0).all():
        return None
    directions = lights.direction[evenly(len(lights.direction), MOST_LIGHTS)]
    count, estimated = len(directions), np.isin(solution.status, ESTIMATED).reshape(given.mask.shape)
    matrix, vector = np.zeros((2, count, 2, 2)), np.zeros((2, count, 2))
    for square in squares(given, lights, solution.normal, estimated, most_lights=MOST_LIGHTS):
        grey = np.where((square.albedo > 0).all(axis=-1), square.albedo.mean(axis=-1), np.nan)
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
    return px if px >= LEAST_PX and both >= LEAST_ALIKE * each else None


def moves_sentence(px: float) -> str:
    """Return what is said of frames that move."""
    return (f"frames: what the camera sees moves by {px:.2g} px or more from image to image, as of a camera held by hand or a stage that "
            "shakes: edges blur, and texture turns normals; fix both, or align the images first")
