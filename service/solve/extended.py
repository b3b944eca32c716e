"""Normals and materials under extended lights (photometric sampling): tables of the lights' responses for each part of the view,
then a search in them, batch by batch."""

from collections.abc import Iterator

import numpy as np

from kernels.photometric.misfit import LARGEST_ERROR
from kernels.photometric.modes import GRID_FLOATS
from kernels.photometric.readings import pad_lights
from kernels.photometric.response_table import SEARCH_LOBES, response_table
from kernels.photometric.sampling import Regime, sampling_tables, solve_sampling
from kernels.status import Status
from service.requests.solve import MAX_SIGMA
from service.solve.batches import pixel_batches, readable, view_directions
from service.solve.solution import Solution, SolveInput
from stage.camera import Camera
from stage.extended_lights import ExtendedLights

PART_DEGREES = 8.0
"""Width of a part of a perspective view that shares a table: at its edge, 4° from its middle, the normal of a metal of roughness
0.5 or 0.7 is off by another 0.3°, that of anything else by less than 0.1°."""
MOSTLY_OPEN = 0.25
"""Fraction of pixels with an open normal above which the sources do not suit the object."""


def solve_extended(given: SolveInput, lights: ExtendedLights) -> Solution:
    """Solve every pixel of the mask for normal, diffuse albedo, F0, roughness and regime.

    Args:
        given: the images.
        lights: lights of the stack.
    """
    stack, mask, count = given.stack, given.mask, given.stack.light_count
    padded = pad_lights(np.tile([0.0, 0.0, 1.0], (count, 1)), lights.irradiance, stack.scale)
    view = view_directions(given.camera)
    result = Solution.empty(stack.pixel_count)
    result.specular, result.roughness = np.zeros((3, stack.pixel_count), np.float16), np.zeros(stack.pixel_count, np.float16)
    result.regime, result.sigma = np.zeros(stack.pixel_count, np.uint8), np.zeros(stack.pixel_count, np.float16)
    given.timings.stage("normals", int(mask.sum()))
    parts = done = 0
    for inside in view_parts(given.camera, mask):
        parts += 1
        rotation = rotation_to_z(view(inside).mean(axis=0, dtype=np.float64))
        tables = sampling_tables(response_table(lights.direction @ rotation.T, lights.solid_angle, lights.light, lights.share,
                                                light_count=count, device=given.device))

        def turned_view(pixels: np.ndarray, rotation: np.ndarray = rotation) -> np.ndarray:
            return (view(pixels) @ rotation.T).astype(np.float32)

        for pixels, samples in pixel_batches(given, padded, turned_view, inside, lobes=SEARCH_LOBES + GRID_FLOATS // count):
            found = solve_sampling(samples, tables, turned_view(pixels))
            status = readable(samples)
            ok = status == Status.OK
            kept = pixels[ok]
            result.status[pixels] = status
            result.normal[:, kept] = (found.normal @ rotation).T[:, ok]
            result.albedo[:, kept] = found.diffuse_albedo.T[:, ok]
            result.specular[:, kept] = found.specular.T[:, ok]
            result.roughness[kept] = found.roughness[ok]
            result.regime[kept] = found.regime[ok]
            result.confidence[kept] = found.confidence[ok]
            result.sigma[kept] = np.minimum(found.sigma[ok], LARGEST_ERROR)
            result.residual[kept] = found.residual[ok]
            done += len(pixels)
            given.timings.advance(done)
    codes = np.bincount(result.regime[mask.reshape(-1)], minlength=len(Regime))
    result.facts = {"light_samples": len(lights.share), "views": parts,
                    "regimes": {regime.name.lower(): int(codes[regime]) for regime in Regime if regime is not Regime.UNSOLVED}}
    found = result.status == Status.OK
    open_share = float((result.sigma[found] > MAX_SIGMA).mean()) if found.any() else 0.0
    if open_share > MOSTLY_OPEN:
        result.warnings.append(f"frames[].light: at {100 * open_share:.0f} % of the pixels the readings leave the normal open by more than "
                               f"{MAX_SIGMA:g}°, as a mirror does that sees hardly any of the sources: give wider sources, or more of them")
    return result


def view_parts(camera: Camera, mask: np.ndarray) -> Iterator[np.ndarray]:
    """Yield the pixels of the mask, [n] positions row by row, in parts that see the object from about one side."""
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
    """Cut the range of angles into equal parts of at most PART_DEGREES, and return the part that each angle is in."""
    width = np.ptp(angle) if angle.size else 0.0
    count = max(1, int(np.ceil(width / PART_DEGREES)))
    return np.minimum(((angle - angle.min(initial=0.0)) * count / max(width, 1e-9)).astype(int), count - 1)


def rotation_to_z(view: np.ndarray) -> np.ndarray:
    """Return [3, 3] the smallest rotation that brings a direction of the camera's half space to z."""
    x, y, z = view / np.linalg.norm(view)
    a = 1 / (1 + z)
    return np.array([[1 - a * x * x, -a * x * y, -x], [-a * x * y, 1 - a * y * y, -y], [x, y, z]])
