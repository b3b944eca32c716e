"""The parts of an object in depth: how far each stands in front of the others, from the cast shadows in its images.

Normals say nothing about the step where one part hides another. Each part is moved along the line of sight to where the shadows that the
height casts agree best with those that the readings show (kernels/surface/offsets.py); the largest part stays. A part whose step the
shadows leave open stays where the normals put it.
"""

import math
from collections.abc import Callable
from functools import cache, partial
from typing import Any, NamedTuple

import numpy as np

from kernels.photometric.lambertian.readings import Lights, pad_lights
from kernels.surface.integrate import Integration
from kernels.surface.offsets import Offset
from service.solve.base.solution import AMBIGUOUS_DEGREES, Solution, SolveInput
from service.solve.height.part_scene import LEAST_SHARE, MOST_PARTS, Material, PartScene
from service.solve.height.torn import Again, tear
from stage.capture.point_lights import DistantLights

SWEEPS = 3
"""Most times that every part is moved: each moves against the others where these lie now."""
SETTLED = 0.25
"""Change of an offset, in its σ, below which the other parts are not judged again."""
NOWHERE = Offset(0.0, math.inf, 0.0, 0.0, 0.0, 0.0)
"""The offset of a part that has not been moved."""
MANY_UNEXPLAINED = 0.1
"""Share of the shadows in the images, thrown by nothing, from which on it is warned of."""
LARGE_SHARE = 0.05
"""Part of the surface from which a part of unknown step is warned of."""


def numbered(part: np.ndarray) -> np.ndarray:
    """Return the mask of a surface that numbers its parts from 1, the largest first: [rows, cols] uint8, 0 outside.

    Args:
        part: [rows, cols] int, -1 outside; all parts beyond the 254th largest share a number.
    """
    inside = part >= 0
    number = np.zeros(part.max() + 2, dtype=int)
    number[1 + np.argsort(-np.bincount(part[inside]), kind="stable")] = np.arange(1, len(number))
    return np.where(inside, np.minimum(number[part + 1], 255), 0).astype(np.uint8)


class PlacedPart(NamedTuple):
    """One part of a surface."""

    pixels: int
    centre: tuple[int, int]
    """Mean row and column."""
    offset: Offset | None
    """The distance that it moved towards the viewer, in the unit of height; None: it is the part against which the others move, or the
    shadows leave its step open."""
    largest: bool
    contradiction: float | None = None
    """Range of the offsets that shadows leave open by contradicting each other, in parts of the object's size; None: the step is known, or
    no shadow tells it."""

    def facts(self) -> dict[str, Any]:
        """Return what the report says about the part."""
        status = "reference" if self.largest else "unknown" if self.offset is None else "known"
        measured = {} if self.offset is None else {"offset": self.offset.offset, "sigma": self.offset.sigma}
        contradicted = {} if self.contradiction is None else {"contradiction": self.contradiction}
        return {"pixels": self.pixels, "centre_px": list(self.centre), "status": status, **measured, **contradicted}


class Placement(NamedTuple):
    """A surface with its parts in depth."""

    height: np.ndarray  # [rows, cols] float32, its mean that of mean_height
    parts: list[PlacedPart]
    """Largest first; none where the surface has no break."""
    unexplained: float = 0.0
    """Share of the shadows in the images that the surface does not throw."""

    def warnings(self) -> list[str]:
        """Return a sentence where a large part may lie anywhere in depth."""
        whole = sum(part.pixels for part in self.parts)
        unknown = [part for part in self.parts if part.offset is None and not part.largest and part.pixels > LARGE_SHARE * whole]
        found = []
        for contradicted in (False, True):
            some = [part for part in unknown if (part.contradiction is not None) == contradicted]
            if some:
                where = ", ".join(f"({part.centre[0]}, {part.centre[1]})" for part in some)
                why = (f"shadows of different lights contradict each other by {max(part.contradiction or 0 for part in some):.0%} of the "
                       "object's size" if contradicted else "no shadow falls across the break")
                found.append(f"height: the step to {len(some)} large part{'s' * (len(some) > 1)} of the object is unknown (around the "
                             f"pixel {where}, row and column): normals do not tell it, and {why}; capture lights from the side")
        if self.unexplained > MANY_UNEXPLAINED:
            found.append(f"height: {self.unexplained:.0%} of the shadows in the images fall where this height throws none: it is too flat, "
                         "as normals under bounced light make it, or something stands farther before what it shades, as sticks and wires "
                         "whose distance no normal tells, or outside the mask")
        return found


def place_parts(given: SolveInput, lights: Lights, normal: np.ndarray, material: Material, surface: Integration,
                height: np.ndarray, again: Again, sure: np.ndarray | None = None) -> tuple[Integration, Placement]:
    """Move the parts of a surface along the line of sight to where their shadows agree with the images; return the surface too, of which
    shadows may have parted what normals joined.

    Args:
        normal: [3, pixels] float32.
        height: [rows, cols] float32, that of the surface.
        sure: [rows, cols] bool, where the shadows in the images are compared with those of the result; None: nowhere.
    """
    assert surface.fragment is not None
    scene_of = cache(partial(PartScene, given, lights, normal, material, surface.fragment >= 0))  # its readings are looked at once
    surface, height = tear(surface, height, scene_of, again)
    part = surface.part
    assert part is not None
    size = np.bincount(part[part >= 0])
    order = np.argsort(-size, kind="stable")
    moved = order[1 : 1 + MOST_PARTS]
    moved = moved[size[moved] >= LEAST_SHARE * size.sum()]
    if not len(moved):
        return surface, Placement(height, [], _unexplained(scene_of, height, part, sure))
    scene = scene_of()
    scene.show(height, part)
    found: dict[int, Offset] = {}
    contradiction: dict[int, float | None] = {}
    settled: set[int] = set()  # judged since any other was placed or moved: they would be placed as they were
    for number in SWEEPS * [int(one) for one in moved]:
        if number in settled:
            continue
        step = scene.step_of(number, against=[int(order[0]), *(other for other in found if other != number)])
        before = found.pop(number, NOWHERE)
        if scene.is_known(step.low, step.high):
            scene.move(number, step.offset)
            found[number] = step._replace(offset=step.offset + before.offset, low=step.low + before.offset, high=step.high + before.offset)
            restless = before is NOWHERE or abs(step.offset) > SETTLED * step.sigma
        elif before is not NOWHERE and step.low <= 0 <= step.high:  # it was placed, and parts placed since do not contradict it
            found[number] = before
            restless = False
        else:
            scene.move(number, -before.offset)
            told = scene.is_known(step.agreed_low, step.agreed_high)
            contradiction[number] = (step.high - step.low) / scene.size if told else None
            restless = before is not NOWHERE
        settled = {number} if restless else {*settled, number}
    placed = []
    for number in (int(one) for one in order[: 1 + len(moved)]):
        row, col = (round(float(axis.mean())) for axis in np.nonzero(part == number))
        offset = scene.in_heights(number, found[number]) if number in found else None
        doubt = None if offset is not None else contradiction.get(number)
        placed.append(PlacedPart(int(size[number]), (row, col), offset, number == int(order[0]), doubt))
    whole = scene.whole_height()
    return surface, Placement(whole, placed, _unexplained(scene_of, whole, part, sure))


def _unexplained(scene_of: Callable[[], PartScene], height: np.ndarray, part: np.ndarray, sure: np.ndarray | None) -> float:
    """Return the share of the shadows at pixels that are sure which the surface does not throw; 0 where there is no such pixel."""
    if sure is None or not (sure & (part >= 0)).any():
        return 0.0
    return scene_of().unexplained(height, part, sure)


def place_solution(given: SolveInput, lights: DistantLights, solution: Solution, again: Again) -> Placement | None:
    """Place the parts of a solution in depth and say so in it; None where it has no height or no parts."""
    if solution.integration is None or solution.height is None or solution.integration.fragment is None:
        return None
    given.timings.stage("parts", 1)
    padded = pad_lights(lights.direction, lights.irradiance, given.stack.scale)
    material = Material(solution.albedo, solution.specular, solution.roughness, solution.brushed)
    solution.integration, placement = place_parts(given, padded, solution.normal, material, solution.integration, solution.height,
                                                  again, solution.standard_error().reshape(given.mask.shape) < AMBIGUOUS_DEGREES)
    solution.facts["unexplained_shadows"] = round(placement.unexplained, 3)
    solution.height = placement.height
    solution.warnings += placement.warnings()
    return placement
