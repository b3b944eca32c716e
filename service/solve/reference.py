"""Normals from a reference ball over an image: its readings as a table, then the search, batch by batch."""

from pathlib import Path

import numpy as np

from kernels.photometric.readings import grey_factors, pad_lights
from kernels.photometric.reference_table import reference_table, solve_reference
from kernels.photometric.response_table import SEARCH_LOBES, nodes
from kernels.status import Status
from service.reporting.progress import Timings
from service.solve.batches import pixel_batches, view_directions
from service.solve.extended import readable
from service.solve.solution import Solution
from stage.camera import Camera
from stage.colour import GREY_WEIGHTS
from stage.ingest import open_stack
from stage.reference_ball import ReferenceBall
from stage.stack import Stack

CACHE_FOLDER = "reference"
"""Of the ball's stack, inside the folder that --cache names."""


def solve_by_reference(stack: Stack, ball: ReferenceBall, camera: Camera, mask: np.ndarray, cache: Path | None, device: str,
                       timings: Timings) -> Solution:
    """Solve every pixel of the mask: the normal, and nothing of its reflectance.

    Args:
        stack: the images.
        ball: under the same lights.
        camera: of the capture.
        mask: [rows, cols] bool.
        cache: folder for the ball's stack cache; None: `.relit` in its folder.
        device: where.
        timings: told of every stage.
    """
    count = stack.light_count
    timings.stage("reference", count)
    theirs = open_stack(ball.capture, cache=None if cache is None else cache / CACHE_FOLDER,
                        progress=lambda done, _: timings.advance(done))
    readings = ball_readings(theirs, ball)
    strength = np.maximum(readings.mean(axis=0), 1e-20)  # lights in units of what the ball returns on average
    table = reference_table(readings / strength, device)
    padded = pad_lights(np.tile([0.0, 0.0, 1.0], (count, 1)), np.repeat(strength[:, None], 3, axis=1), stack.scale)
    factors, view = grey_factors(padded, GREY_WEIGHTS), view_directions(camera)
    inside = np.flatnonzero(mask.reshape(-1))
    result = Solution.empty(stack.pixel_count)
    result.facts = {"reference": {"capture": str(ball.capture.folder), "content": theirs.key,
                                  "radius_px": round(ball.ball.radius_px, 2),
                                  "outline_error_px": round(ball.ball.outline_error_px, 4)}}
    timings.stage("normals", len(inside))
    for where, samples in pixel_batches(stack, padded, factors, view, inside, device, lobes=SEARCH_LOBES):
        found = solve_reference(samples, table, view(where))
        status = readable(samples)
        ok = status == Status.OK
        result.status[where] = status
        result.normal[:, where[ok]] = found.normal.T[:, ok]
        result.confidence[where[ok]] = found.confidence[ok]
        result.residual[where[ok]] = found.residual[ok]
        timings.advance(int(np.searchsorted(inside, where[-1])) + 1)
    return result


def ball_readings(stack: Stack, ball: ReferenceBall) -> np.ndarray:
    """[nodes, lights] grey radiance of the ball at the normals of the table, bilinear; not negative."""
    width, height = ball.capture.camera.resolution
    column, row = ball.pixel_of(nodes())
    left = np.clip(np.floor(column).astype(int), 0, width - 2)
    top = np.clip(np.floor(row).astype(int), 0, height - 2)
    across, down = np.clip(column - left, 0, 1), np.clip(row - top, 0, 1)
    values = stack.band(0, stack.shape[2])
    grey = np.zeros((stack.light_count, len(column)))
    for light in range(stack.light_count):
        plane = np.tensordot(np.array(GREY_WEIGHTS), values[:, light, : width * height].astype(np.float64), axes=1)
        plane = np.nan_to_num(plane * stack.scale[light], nan=0.0, posinf=0.0, neginf=0.0).reshape(height, width)
        upper = (1 - across) * plane[top, left] + across * plane[top, left + 1]
        lower = (1 - across) * plane[top + 1, left] + across * plane[top + 1, left + 1]
        grey[light] = (1 - down) * upper + down * lower
    return np.maximum(grey.T, 0)
