"""Solve under near lights: normals and height by turns, because each pixel sees a light from where its surface point is.

The surface begins as the plane of the camera's surface_z_m. Every round solves the normals for the directions and distances of
the present points and integrates them; it ends when the height no longer moves. The general solver begins with the surface on
which `robust`, which costs a hundredth, has settled.
"""

from typing import NamedTuple

import numpy as np

from kernels.photometric.near import NearField, pad_places
from kernels.photometric.readings import pad_lights
from kernels.status import Status
from kernels.surface.integrate import Integration
from service.reporting.progress import Timings
from service.requests.solve import Method
from service.solve.distant import solve_normals
from service.solve.height import integrate, mark_not_facing, mean_height
from service.solve.solution import Solution
from service.solve.whole_surface import whole_surface
from stage.camera import Camera
from stage.point_lights import PlacedLights
from stage.stack import Stack

SETTLED = 1e-3
"""The rounds end when heights change by less than this part of the relief: a tenth of the error that we hold them to."""
SETTLED_PERCENT = 99.5
"""Of the pixels that must have settled: one at the rim may go to and fro between lights that it does and does not see."""
ROUNDS = 20
"""At most; five to seven are usual with lights at 1.3 object radii, twelve with a rim seen edge on, three at three radii."""
STALLED = 4
"""They end too when so many rounds in a row moved the surface no less than one before: noise then decides what is shadow."""
MATERIAL_ROUNDS = 3
"""At most, of the general solver, on a surface that is nearly settled: a round leaves about a tenth of the change before it."""


class NearSolution(NamedTuple):
    """What the last round found."""

    solution: Solution
    height: np.ndarray | None  # [rows, cols] float32, camera-frame z, 0 where not solved; None: nothing was solved
    integration: Integration | None


def solve_near(method: Method, stack: Stack, lights: PlacedLights, camera: Camera, mask: np.ndarray, device: str,
               timings: Timings) -> NearSolution:
    """Solve every pixel of the mask.

    Args:
        method: lambert, robust or svbrdf.
        stack: the images.
        lights: of the stack, distant and near.
        camera: of the capture, with a scale.
        mask: [rows, cols] bool.
        device: where.
        timings: told of every stage, once a round.

    Returns:
        The last round; the solution's facts say how many there were and how far the last one moved the surface.
    """
    padded = pad_lights(lights.direction, lights.strength, stack.scale)
    places = pad_places(lights.place, lights.lobe)
    height = np.full(mask.shape, mean_height(camera), dtype=np.float32)
    rounds: dict[str, int] = {}
    change, settled, restless = np.inf, False, np.zeros(mask.size, dtype=bool)
    for turn in (Method.ROBUST, Method.SVBRDF) if method is Method.SVBRDF else (method,):
        least, idle = np.inf, 0
        for number in range(1, (MATERIAL_ROUNDS if turn is Method.SVBRDF else ROUNDS) + 1):
            points = np.moveaxis(camera.points(height), -1, 0).reshape(3, -1)
            solution = solve_normals(turn, stack, padded, camera, mask, device, timings, NearField(places, points))
            mark_not_facing(camera, solution)
            solved = (solution.status == Status.OK).reshape(mask.shape)
            timings.stage("height", 100)
            integration = integrate(camera, solution.normal, solved, device, lambda part: timings.advance(round(100 * part)))
            rounds[str(turn)] = number
            if integration is None:
                return NearSolution(solution, None, None)
            found = whole_surface(integration.height.numpy(), solved, mask, mean_z=mean_height(camera),
                                  perspective=camera.projection == "perspective")
            relief = max(float(np.ptp(found[solved])), 1e-12)
            change = float(np.percentile(np.abs(found - height)[solved], SETTLED_PERCENT)) / relief
            restless = (solved & (np.abs(found - height) > SETTLED * relief)).reshape(-1)
            height = found
            settled = change < SETTLED
            least, idle = (change, 0) if change < least else (least, idle + 1)
            if settled or idle == STALLED:
                break
    if not settled:
        solution.status[restless & (solution.status == Status.OK)] = Status.NOT_CONVERGED
    solution.facts = {**solution.facts, "near": {"rounds": rounds, "last_change_of_relief": round(change, 6), "settled": settled}}
    return NearSolution(solution, np.where(solved, height, 0).astype(np.float32), integration)
