"""Normals and reflectance under distant lights, one a frame."""

from typing import Protocol

from kernels.photometric.near import NearField
from kernels.photometric.readings import Lights, pad_lights
from service.solve.solution import Solution, SolveInput
from stage.point_lights import DistantLights


class NormalSolver(Protocol):
    """Solves the normals of every pixel of the mask from frames with one light each: `solve_diffuse` or `solve_material`."""

    def __call__(self, given: SolveInput, lights: Lights, field: NearField | None = None) -> Solution:
        """Return the solution.

        Args:
            given: the images.
            lights: lights of the stack, padded.
            field: where the lights are, and the surface point of each pixel, where some light is near.
        """


def solve_distant(given: SolveInput, lights: DistantLights, *, solver: NormalSolver) -> Solution:
    """Solve every pixel of the mask under distant lights.

    Args:
        given: the images.
        lights: lights of the stack.
        solver: finds the normals.
    """
    return solver(given, pad_lights(lights.direction, lights.irradiance, given.stack.scale))
