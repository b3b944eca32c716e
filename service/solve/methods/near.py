"""Normals and height under near lights, which every pixel sees from where its surface point is.

The surface begins as the plane of the camera's surface_z_m. Every round solves the normals for the directions and distances of
the present points and integrates them; the rounds end when the height no longer moves. `svbrdf` begins with the surface on which
`robust`, which costs a hundredth, has settled. Its rounds after the first begin with what the one before found, so that cast shadows and
interreflection are those of a surface that was solved without them.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol

import numpy as np

from kernels.device import to_numpy
from kernels.photometric.lambertian.near import NearField, pad_places
from kernels.photometric.lambertian.readings import Lights, pad_lights
from kernels.status import Status
from service.requests.solve import Method
from service.solve.base.solution import Solution, SolveInput, mark_not_facing
from service.solve.height.height import integrate, mean_height, whole_surface
from stage.capture.point_lights import PlacedLights

SETTLED = 1e-3
"""The rounds end when heights change by less than this part of the relief, a tenth of the error that the tests allow."""
SETTLED_PERCENT = 99.5
"""Percentage of the pixels that must have settled: a pixel at the rim may alternate between two heights, because a light sees it in one
round and not in the next."""
ROUNDS = 20
"""Most rounds; five to seven are usual with lights at 1.3 object radii, twelve with a rim seen edge on, three at three radii."""
STALLED = 4
"""Number of rounds in a row without a smaller change of the surface after which the rounds end too: noise then decides which pixels are in
shadow."""
MATERIAL_ROUNDS = 4
"""Most rounds of `svbrdf`, which start on a surface that has nearly settled: a round leaves about a tenth of the change before it, where
the object throws much light on itself a half. A round after the first is two thirds of its work."""


class NormalSolver(Protocol):
    """Solves the normals of every pixel of the mask from frames with one light each: `solve_diffuse` or `solve_material`."""

    def __call__(self, given: SolveInput, lights: Lights, field: NearField | None = None) -> Solution:
        """Return the solution."""


class Rounds(NamedTuple):
    """Rounds in which one solver finds the normals."""

    method: Method
    solver: NormalSolver
    most: int = ROUNDS
    refine: Callable[[SolveInput, Lights, NearField, Solution], Solution] | None = None
    """Solves a round from the solution of the one before; None: every round begins anew."""


def solve_near(given: SolveInput, lights: PlacedLights, *, series: Sequence[Rounds]) -> Solution:
    """Solve every pixel of the mask under lights of which some are near, and its height with it.
    `series`: the rounds of each solver; a solver begins with the surface on which the one before it has settled. Returns the last round;
    the solution's facts say how many there were and how far the last one moved the surface."""
    camera, mask = given.camera, given.mask
    padded = pad_lights(lights.direction, lights.strength, given.stack.scale)
    height = np.full(mask.shape, mean_height(camera), dtype=np.float32)
    rounds: dict[str, int] = {}
    solution = Solution.empty(mask.size)
    change, settled, restless = np.inf, False, np.zeros(mask.size, dtype=bool)
    for method, solver, most, refine in series:
        least, idle = np.inf, 0
        for number in range(1, most + 1):
            field = field_on(given, lights, height)
            solution = solver(given, padded, field) if number == 1 or refine is None else refine(given, padded, field, solution)
            mark_not_facing(camera, solution)
            solved = (solution.status == Status.OK).reshape(mask.shape)
            integration = integrate(given, solution.normal, solved)
            rounds[str(method)] = number
            if integration is None:
                return solution
            found = whole_surface(to_numpy(integration.height), solved, mask, mean_z=mean_height(camera),
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
    integration = integrate(given, solution.normal, solved, sigma=solution.standard_error())
    assert integration is not None  # a round without a solved pixel has returned
    height = whole_surface(to_numpy(integration.height), solved, mask, mean_z=mean_height(camera),
                           perspective=camera.projection == "perspective")
    solution.facts = {**solution.facts, "near": {"rounds": rounds, "last_change_of_relief": round(change, 6), "settled": settled}}
    solution.height, solution.integration = np.where(solved, height, 0).astype(np.float32), integration
    return solution


def field_on(given: SolveInput, lights: PlacedLights, height: np.ndarray) -> NearField:
    """Return the lights as the points of a surface see them, whose height is [rows, cols], z in the camera's frame."""
    return NearField(pad_places(lights.place, lights.lobe), np.moveaxis(given.camera.points(height), -1, 0).reshape(3, -1))


def solve_once(given: SolveInput, lights: PlacedLights, first: Rounds, solver: NormalSolver) -> Solution:
    """Solve every pixel of the mask under lights that are near, once, on the surface on which the `first` rounds have settled."""
    before = solve_near(given, lights, series=(first,))
    solved, mean_z = (before.status == Status.OK).reshape(given.mask.shape), mean_height(given.camera)
    height = np.full(given.mask.shape, mean_z, np.float32) if before.height is None else whole_surface(
        before.height, solved, given.mask, mean_z=mean_z, perspective=given.camera.projection == "perspective")
    solution = solver(given, pad_lights(lights.direction, lights.strength, given.stack.scale), field_on(given, lights, height))
    mark_not_facing(given.camera, solution)
    solved = (solution.status == Status.OK).reshape(given.mask.shape)
    solution.integration = integrate(given, solution.normal, solved, sigma=solution.standard_error())
    solution.height = None if solution.integration is None else to_numpy(solution.integration.height)
    return solution
