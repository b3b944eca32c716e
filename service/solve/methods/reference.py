"""Normals from a reference ball of the object's material: its readings as a table, then a search in it, batch by batch.

The search of `hypotheses` with one lobe, the ball's, at every candidate normal; its weight is how bright the pixel is beside the
ball, so albedo may vary and the kind of reflectance may not. What the ball leaves unexplained on all pixels is the noise of the posterior:
a ball of another material widens it.

Source: Woodham, "Photometric method for determining surface orientation from multiple images", Optical Engineering 1980
(lookup table from a calibration sphere); Hertzmann and Seitz, "Example-based photometric stereo", TPAMI 2005.
"""

from typing import NamedTuple

import numpy as np
import warp as wp

from kernels.errors import ArrayError
from kernels.photometric.lambertian.readings import pad_lights
from kernels.photometric.model.misfit import LARGEST_ERROR
from kernels.photometric.model.response_table import SEARCH_LOBES, nodes
from kernels.photometric.model.samples import Samples
from kernels.photometric.posterior.modes import GRID_FLOATS, find_modes, weigh
from kernels.photometric.posterior.posterior import Group, bounded, measure_noise, normal_posterior
from kernels.photometric.posterior.sampling import AROUND, AROUND_OPTIONS, FINE, OPTIONS
from kernels.photometric.search.hypotheses import LobeShape, search_normals
from kernels.status import Status
from service.sharing.sharing import Results
from service.solve.base.batches import Batch, each_batch, readable, view_directions
from service.solve.base.solution import Solution, SolveInput
from service.solve.methods.reference_ball import ReferenceBall
from stage.colour.colour import GREY_WEIGHTS
from stage.stack.ingest import open_stack
from stage.stack.stack import Stack


class ReferenceFit(NamedTuple):
    """Normal of each sampled pixel, on the host."""

    normal: np.ndarray  # [n, 3] float32, unit
    sigma: np.ndarray  # [n] float32: standard deviation of the normal over its modes, degrees
    residual: np.ndarray  # [n] float32: root of the mean cost per light, in units of the noise
    excess: np.ndarray  # [n] float32: the square of what the ball leaves unexplained over the noise of the object's readings


def solve_reference(samples: Samples, table: wp.array, view: np.ndarray) -> ReferenceFit:
    """Estimate the normals of sampled pixels, whose readings are in the units of the ball's; waits for the device.
    `table`: [nodes, lights, 1] float32, the readings of the ball at each of response_table.nodes. `view`: [n, 3] unit directions to the
    viewer."""
    model = bounded(table, samples)
    starts = find_modes(samples, model, view)
    near = [search_normals(samples, start, shape=LobeShape(), options=AROUND_OPTIONS, wide=AROUND[0], fine=AROUND[1:], table=table).normal
            for start in starts]
    found = search_normals(samples, near[0], shape=LobeShape(), options=OPTIONS, wide=FINE[0], fine=FINE[1:], table=table)
    first = Group(samples, model, found.normal)
    noise = measure_noise([first])
    modes = weigh(normal_posterior(first, noise), normal_posterior(first._replace(normal=near[1]), noise))
    normal = np.where(modes.close_to(found.normal)[:, None], found.normal, modes.normal)
    return ReferenceFit(normal, modes.spread, np.sqrt(found.cost), modes.excess)


CACHE_FOLDER = "reference"
"""Folder of the ball's stack, inside the folder that --cache names."""
OTHER_MATERIAL = 1.7
"""The part that the ball leaves unexplained over the noise of the readings, above which it is of another material: 0.7 to 1.1 with the
right ball under noise of 0 to 10 %, 1.3 with a metal ball whose roughness is 0.5 for 0.6, and 2.4 to 5 between a metal and a dielectric."""


def solve_by_reference(given: SolveInput, ball: ReferenceBall) -> Solution:
    """Solve every pixel of the mask for its normal alone, from a ball under the same lights."""
    stack, timings, count = given.stack, given.timings, given.stack.light_count
    timings.stage("reference", count)
    ball_stack = open_stack(ball.capture, cache=None if given.cache is None else given.cache / CACHE_FOLDER,
                            progress=lambda done, _: timings.advance(done))
    readings = ball_readings(ball_stack, ball)
    strength = np.maximum(readings.mean(axis=0), 1e-20)  # lights in units of what the ball returns on average
    if not readings.any():
        raise ArrayError("readings of the ball must not be negative, and some must be above zero")
    tables = {device: wp.array((readings / strength)[..., None], dtype=wp.float32, device=device) for device in given.devices}
    padded = pad_lights(np.tile([0.0, 0.0, 1.0], (count, 1)), np.repeat(strength[:, None], 3, axis=1), stack.scale)
    view = view_directions(given.camera)
    inside = np.flatnonzero(given.mask.reshape(-1))
    result = Solution.empty(stack.pixel_count)
    result.contents = {"reference_ball": ball_stack.key}
    result.facts = {"reference": {"capture": str(ball.capture.folder), "content": ball_stack.key,
                                  "radius_px": round(ball.ball.radius_px, 2),
                                  "outline_error_px": round(ball.ball.outline_error_px, 4)}}
    excess = np.zeros(stack.pixel_count, np.float32)
    timings.stage("normals", len(inside))

    def search(batch: Batch) -> None:
        pixels, samples = batch
        found = solve_reference(samples, tables[samples.device], view(pixels))
        status = readable(samples)
        ok = status == Status.OK
        kept = pixels[ok]
        result.status[pixels] = status
        result.normal[:, kept] = found.normal.T[:, ok]
        result.sigma[kept] = np.minimum(found.sigma[ok], LARGEST_ERROR)
        result.residual[kept] = found.residual[ok]
        excess[kept] = found.excess[ok]

    results = Results((result.status, result.normal, result.sigma, result.residual, excess), readings)
    each_batch(given, padded, view, inside, search, results, lobes=SEARCH_LOBES + GRID_FLOATS // count)
    solved = result.status == Status.OK
    unexplained = float(np.sqrt(np.median(excess[solved]))) if solved.any() else 0.0
    result.facts["reference"]["unexplained_over_noise"] = round(unexplained, 2)
    if unexplained > OTHER_MATERIAL:
        result.warnings.append(
            f"--reference-ball {ball.capture.folder}: its readings, scaled, miss those of the object by {unexplained:.1f} times their "
            "noise (median): the ball is of another material, or under other lights; photograph a ball of the object's material, or solve "
            "with --method svbrdf")
    return result


def ball_readings(stack: Stack, ball: ReferenceBall) -> np.ndarray:
    """Return [nodes, lights] the grey radiance of the ball at the normals of the table, bilinear and not negative."""
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
