"""Whether all lights are declared turned alike, as where their table is in the frame of the rig and the camera looks along another axis.

Turned lights explain the shading of the images as well as the right ones: normals are turned with them. Slopes tell such turns, because
they are no longer those of a height, and highlights do, which turn otherwise.
"""

from dataclasses import replace
from typing import Any, NamedTuple, TypeVar

import numpy as np
from scipy.spatial.transform import Rotation

from kernels.photometric.model.samples import some_of
from kernels.status import ESTIMATED
from service.light_estimation.explanations import MIN_PART, PIXELS, grey_readings
from service.light_estimation.lambertian import fit_lambertian
from service.requests.solve import Method
from service.solve.base.solution import Solution, SolveInput
from service.solve.height.distance import near_sample, surface_at
from service.solve.height.height import mean_height
from service.solve.lights.highlight_turn import LEAST_LIGHTS, Shown, turn_by_highlights
from service.solve.lights.slope_turn import Nearness, turn_by_slopes
from service.solve.methods.methods import METHODS
from stage.capture.point_lights import DistantLights, PlacedLights
from stage.spread import MAD_TO_SIGMA

Lights = TypeVar("Lights", DistantLights, PlacedLights)

LEAST_DEGREES, LARGEST_DEGREES = 1.5, 20.0
"""Least turn that is remarked on, and the largest that is one: metal and velvet, which no Lambertian fit explains, make up larger ones."""
LARGEST_MATT, LARGEST_MISFIT = 75.0, 0.025
"""Largest turn by slopes of a surface whose readings fit Lambert's law to the second number: metal leaves 0.13 to 0.2, velvet 0.045."""
APART = 3.0
"""Standard deviations by which turns by slopes and by highlights may differ, where there are highlights; beyond them slopes are bent by
what the model lacks."""
MODEL = np.radians(0.5)
"""Error of a turn that reflectances cause which the model does not have: lobes that are no GGX's make it 0.4 to 0.7°."""


class Turn(NamedTuple):
    """How all lights are turned, as the images say."""

    right: Rotation
    """The turn that brings declared directions, and normals that were solved with them, to the right ones."""
    covariance: np.ndarray  # [3, 3] of its rotation vector, rad²

    @property
    def sigma_degrees(self) -> float:
        """Return the standard deviation of a direction that is turned, degrees."""
        return float(np.degrees(np.sqrt(2 / 3 * np.trace(self.covariance))))

    def of(self, lights: Lights) -> Lights:
        """Return lights that are turned, near ones about the centre of the object."""
        if isinstance(lights, DistantLights):
            return DistantLights(self.right.apply(lights.direction), lights.irradiance)
        near = lights.place[:, 3:]
        place = self.right.apply(lights.place[:, :3] - near * lights.centre) + near * lights.centre
        lobe = np.concatenate([self.right.apply(lights.lobe[:, :3]), lights.lobe[:, 3:]], axis=1)
        return PlacedLights.about(lights.centre, np.concatenate([place, near], axis=1), lights.strength, lobe)

    def after(self, other: "Turn | None") -> "Turn":
        """Return this turn after another one that was made before it was found."""
        return self if other is None else self._replace(right=self.right * other.right)

    def words(self) -> str:
        """Return by how much declared directions are off, for a sentence."""
        axis = self.right.as_rotvec() / self.right.magnitude()
        parts = ", ".join(f"{name} {part:+.2f}" for name, part in zip(("right", "up", "towards the camera"), axis, strict=True))
        return f"by {np.degrees(self.right.magnitude()):.1f}° about the axis ({parts})"

    def undone(self) -> str:
        """Return that the turn was undone, for a sentence."""
        return f"all lights were turned {self.words()}, as slopes or highlights say"

    def facts(self) -> dict[str, Any]:
        """Return the turn as the report has it."""
        return {"turn_degrees": [float(f"{angle:.4g}") for angle in np.degrees(self.right.as_rotvec())],
                "sigma_degrees": float(f"{self.sigma_degrees:.3g}")}

    def error(self, normal: np.ndarray) -> np.ndarray:
        """Return by how much normals [3, pixels] differ from the right ones, [pixels] float32 degrees."""
        moved = np.linalg.norm((self.right.as_matrix() - np.eye(3)).astype(np.float32) @ normal, axis=0)
        return np.hypot(np.degrees(2 * np.arcsin(np.clip(moved / 2, 0, 1))), np.float32(self.sigma_degrees))


def find_turn(given: SolveInput, lights: DistantLights | PlacedLights, solution: Solution) -> Turn | None:
    """Return how lights are turned, by the surer of both ways; None where nothing says that they are.
    `solution`: that under these lights."""
    if isinstance(lights, PlacedLights) and solution.height is None:
        return None  # there is no surface
    solved = np.isin(solution.status, ESTIMATED)
    by_slopes = turn_by_slopes(solution.normal, solved.reshape(given.mask.shape), given.camera,
                               _nearness(lights, solution.height), strict=len(lights.direction) < LEAST_LIGHTS)
    shown = turn_by_highlights(given, lights, solution.normal, solved, solution.height)
    found = []
    if by_slopes is not None and (shown is None or _agree(by_slopes, shown)):
        found.append(by_slopes)
    if shown is not None and shown.sure:
        found.append((shown.right, shown.covariance))
    turns = [Turn(right, covariance + MODEL**2 * np.eye(3)) for right, covariance in found]
    likely = [turn for turn in turns if LEAST_DEGREES <= np.degrees(turn.right.magnitude()) <= LARGEST_DEGREES]
    if not likely and by_slopes is not None and LARGEST_DEGREES < np.degrees(by_slopes[0].magnitude()) <= LARGEST_MATT and _is_matt(
            given, lights, solved):
        return Turn(by_slopes[0], by_slopes[1] + MODEL**2 * np.eye(3))
    return min(likely, key=lambda turn: turn.sigma_degrees, default=None)


def _is_matt(given: SolveInput, lights: DistantLights | PlacedLights, solved: np.ndarray) -> bool:
    """Return whether the readings of solved pixels [pixels of the image] bool fit Lambert's law, which many lights can tell."""
    if len(lights.direction) < LEAST_LIGHTS:
        return False
    if isinstance(lights, PlacedLights):
        sample = near_sample(given.camera, given.mask, given.stack, lights)
        near = surface_at(sample, sample.top - mean_height(given.camera), "cpu")
        return bool(near.lit.any() and MAD_TO_SIGMA * np.median(np.abs(near.residual[near.lit])) <= LARGEST_MISFIT)
    radiance, usable = given.stack.pick_radiance(some_of(solved, PIXELS))
    fit = fit_lambertian(grey_readings(radiance, lights.irradiance), usable, lights.direction)
    return bool(fit.spare.mean() >= MIN_PART and fit.misfit() <= LARGEST_MISFIT)


def _nearness(lights: DistantLights | PlacedLights, height: np.ndarray | None) -> Nearness | None:
    """Return where near lights stand; None: they are far, or there is no surface."""
    if isinstance(lights, DistantLights) or height is None:
        return None
    near = lights.place[:, 3]
    return Nearness(height, lights.centre,
                    float((near / np.linalg.norm(lights.place[:, :3] - near[:, None] * lights.centre, axis=1)).mean()))


def turn_of(given: SolveInput, lights: Lights) -> Turn | None:
    """Return how lights are turned, as `robust` solves the capture under them."""
    return find_turn(given, lights, METHODS[Method.ROBUST].solvers[type(lights)](replace(given, sharing=None), lights))


def _agree(by_slopes: tuple[Rotation, np.ndarray], shown: Shown) -> bool:
    """Return whether slopes say the same as highlights, but for a turn about the viewing axis, of which highlights say nothing."""
    right, covariance = by_slopes
    apart = (right.as_rotvec() - shown.right.as_rotvec())[:2]
    both = (covariance + shown.covariance)[:2, :2] + 2 * MODEL**2 * np.eye(2)
    return bool(apart @ np.linalg.solve(both, apart) < APART**2)
