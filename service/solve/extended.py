"""Photometric sampling over an image: tables of the lights' responses for each part of the view, then the search, batch by
batch."""

from collections.abc import Iterator

import numpy as np

from kernels.photometric.readings import grey_factors, pad_lights
from kernels.photometric.response_table import SEARCH_LOBES, response_table
from kernels.photometric.samples import Samples
from kernels.photometric.sampling import Regime, sampling_tables, solve_sampling
from kernels.status import Status
from service.reporting.progress import Timings
from service.solve.batches import pixel_batches, view_directions
from service.solve.solution import Solution
from stage.camera import Camera
from stage.colour import GREY_WEIGHTS
from stage.extended_lights import ExtendedLights
from stage.stack import Stack

PART_DEGREES = 8.0
"""Width of a part of a perspective view that shares a table: at its edge, 4° from its middle, the normal of a metal of roughness
0.5 or 0.7 is off by another 0.3°, that of anything else by less than 0.1°."""
LEAST_READINGS = 3
"""Frames with a reading, dark or not, that a normal needs."""


def solve_extended(stack: Stack, lights: ExtendedLights, camera: Camera, mask: np.ndarray, device: str,
                   timings: Timings) -> Solution:
    """Solve every pixel of the mask: normal, diffuse albedo, F0, roughness and regime.

    Args:
        stack: the images.
        lights: of the stack.
        camera: of the capture.
        mask: [rows, cols] bool.
        device: where.
        timings: told of every stage.
    """
    count = stack.light_count
    padded = pad_lights(np.tile([0.0, 0.0, 1.0], (count, 1)), lights.irradiance, stack.scale)
    factors, view = grey_factors(padded, GREY_WEIGHTS), view_directions(camera)
    result = Solution.empty(stack.pixel_count)
    result.specular, result.roughness = np.zeros((3, stack.pixel_count), np.float16), np.zeros(stack.pixel_count, np.float16)
    result.regime = np.zeros(stack.pixel_count, np.uint8)
    timings.stage("normals", int(mask.sum()))
    parts = done = 0
    for inside in view_parts(camera, mask):
        parts += 1
        turn = turn_to_z(view(inside).mean(axis=0, dtype=np.float64))
        tables = sampling_tables(response_table(lights.direction @ turn.T, lights.solid_angle, lights.light, lights.share,
                                                light_count=count, device=device))

        def seen(positions: np.ndarray, turn: np.ndarray = turn) -> np.ndarray:
            return (view(positions) @ turn.T).astype(np.float32)

        for where, samples in pixel_batches(stack, padded, factors, seen, inside, device, lobes=SEARCH_LOBES):
            found = solve_sampling(samples, tables, seen(where))
            status = readable(samples)
            ok = status == Status.OK
            kept = where[ok]
            result.status[where] = status
            result.normal[:, kept] = (found.normal @ turn).T[:, ok]
            result.albedo[:, kept] = found.diffuse_albedo.T[:, ok]
            result.specular[:, kept] = found.specular.T[:, ok]
            result.roughness[kept] = found.roughness[ok]
            result.regime[kept] = found.regime[ok]
            result.confidence[kept] = found.confidence[ok]
            result.residual[kept] = found.residual[ok]
            done += len(where)
            timings.advance(done)
    codes = np.bincount(result.regime[mask.reshape(-1)], minlength=len(Regime))
    result.facts = {"light_samples": len(lights.share), "views": parts,
                    "regimes": {regime.name.lower(): int(codes[regime]) for regime in Regime if regime is not Regime.UNSOLVED}}
    return result


def view_parts(camera: Camera, mask: np.ndarray) -> Iterator[np.ndarray]:
    """Pixels of the mask, [n] positions row by row, in parts that see the object from about one side."""
    inside = np.flatnonzero(mask.reshape(-1))
    if camera.projection == "orthographic":
        yield inside
        return
    x, y = (np.degrees(np.arctan(plane.reshape(-1)[inside])) for plane in camera.plane_coordinates())
    column, row = (_parts(angle) for angle in (x, y))
    key = row * (column.max(initial=0) + 1) + column
    for part in np.unique(key):
        yield inside[key == part]


def _parts(angle: np.ndarray) -> np.ndarray:
    """Cut the range of angles into equal parts of at most PART_DEGREES; which part each is in."""
    width = np.ptp(angle) if angle.size else 0.0
    count = max(1, int(np.ceil(width / PART_DEGREES)))
    return np.minimum(((angle - angle.min(initial=0.0)) * count / max(width, 1e-9)).astype(int), count - 1)


def turn_to_z(view: np.ndarray) -> np.ndarray:
    """[3, 3] the least rotation that brings a direction of the camera's half space to z."""
    x, y, z = view / np.linalg.norm(view)
    a = 1 / (1 + z)
    return np.array([[1 - a * x * x, -a * x * y, -x], [-a * x * y, 1 - a * y * y, -y], [x, y, z]])


def readable(samples: Samples) -> np.ndarray:
    """[n] uint8: OK where enough frames have a reading and one of them is above zero. Waits for the device."""
    width = (samples.packs, samples.light_count) if samples.light_stride == 1 else (samples.light_count, samples.packs)
    values = samples.grey.numpy().reshape(*width, samples.lanes)
    values = values.transpose(1, 0, 2) if samples.light_stride == 1 else values
    values = values.reshape(samples.light_count, -1)[:, : samples.pixel_count]
    status = np.where((values > 0).any(axis=0), int(Status.OK), int(Status.DARK))
    return np.where((values >= 0).sum(axis=0) >= LEAST_READINGS, status, int(Status.TOO_FEW_LIGHTS)).astype(np.uint8)
