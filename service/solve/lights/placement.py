"""Whether near lights stand elsewhere than declared: all of them moved or turned alike, or farther from or nearer to the origin by one
factor.

So rigs are misplaced: their origin is not that of the camera, the surface is not where it was said, the camera looks along another axis, or
a scale is wrong. The normals take up a part, as degrees that all have in common; that light falls off over the object otherwise than it
should is left at every pixel, and tells three lengths, the factor and three angles.
"""

from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from service.light_estimation.lambertian import degrees_between
from service.solve.base.solution import SolveInput, at_all_pixels
from service.solve.height.distance import (
    LEAST_LIGHTS,
    LEAST_PIXELS,
    SQUARES,
    SURE,
    Lamps,
    NearFit,
    cost_of,
    near_sample,
    squares_of,
    surface_at,
)
from service.solve.height.height import mean_height
from service.solve.lights.turn import Turn, turn_of
from stage.capture.point_lights import PlacedLights
from stage.errors import CalibrationError

STEP = 0.05
"""First step of the search, in the largest distance between two lights, and as a part of the factor."""
PROBE, LEAST_SLOPE = 0.0125, 0.003
"""Steps to either side that are tried before a search, and the least part of the cost that one of them must take away."""
MOST_FITS, LENGTH, COST = 200, 2e-3, 1e-4
"""Fits after which the search ends, and the lengths (in that distance) and costs that end it before."""
ANGLE, MOST_FITS_TURNED = 0.2, 500
"""First step of the search for a turn, rad, and the fits after which that search ends: turns of 24 to 38° took 420 to 490."""
CLEAR_GAIN, LEAST_TURN, LEAST_TURN_UNCLEAR = 0.25, np.radians(5.0), np.radians(15.0)
"""Part of the cost of moved lights that a turn takes away, from which on it is clear, and the least turn then and below: of rigs that were
moved alone a turn of 5 to 7° takes 7 % away on ripples that the grid does not follow, of those turned by 25 to 40° 9 to 90 %."""
LEAST_GAIN = 0.06
"""Least part of the cost of the readings that other places take away. Where the declared ones are right it is up to 0.02, on gloss too."""
EXPLAINED = 2.0
"""Largest cost of half of the pixels under other places: velvet, which no Lambertian fit explains, leaves 2.6, gloss 1.3."""
DEVICE = "cpu"
"""A grid of 32 × 32 pixels is solved some hundred times: a GPU would wait for the launches."""
QUIET = 0.01
"""Cost that is added to what gains are parts of: that of a residual of a five hundredth, which rounding and a coarse grid leave."""
OTHER_UNIT, LEAST_COST = 0.3, 0.2
"""Largest part of the cost of the readings that another unit leaves, and least cost of half of the pixels as declared, from which on that
unit is named: right lights cost 0.05 on matt objects with noise, and hundreds of times nearer ones cost more on any."""
UNITS = {"millimetres": 0.001, "centimetres": 0.01, "inches": 0.0254}
"""Units in which positions may stand, metres."""
MOST_TURNS = 3
"""Largest number of turns, each found after the one before was undone: one about the viewing axis is found a third too large at first."""
MOST_MOVED, MOST_FACTOR = 2.0, 5.0
"""Largest move in the distance between two lights, and largest factor or its inverse: farther ones make up for another fault."""


class Placement(NamedTuple):
    """Places of near lights that explain the images much better than the declared ones."""

    sentence: str
    facts: dict[str, Any]
    """Facts for the report."""
    degrees: np.ndarray  # [pixels of the image] float32, angle between the normals under these and under the declared; 0 outside the mask


class RefinedPlaces(NamedTuple):
    """Near lights that were moved together until they explain the images."""

    lights: PlacedLights
    left_degrees: np.ndarray  # [pixels of the image] float32, standard error of the normals for what the places have wrong
    facts: dict[str, Any]
    """Facts for the report."""
    warnings: tuple[str, ...]

    def doubt(self, normal: np.ndarray) -> np.ndarray:
        """Return the standard error of normals [3, pixels] for what all places have wrong together, [pixels] degrees."""
        return self.left_degrees


class Move(NamedTuple):
    """How near lights are moved together."""

    values: np.ndarray  # [7] three lengths in the largest distance between two lights, the logarithm of a factor, and a rotation vector
    irradiance_holds: bool
    """Whether their irradiance at the object is what was declared, as where it was measured there, and not their intensity."""

    @property
    def plausible(self) -> bool:
        """Return whether so a rig may be misplaced."""
        return bool(np.abs(self.values[:3]).max() < MOST_MOVED and abs(self.values[3]) < np.log(MOST_FACTOR)
                    and self.turn.right.magnitude() < np.pi / 2)

    @property
    def is_turned(self) -> bool:
        """Return whether the lights are turned."""
        return bool(self.values[4:].any())

    @property
    def turn(self) -> Turn:
        """Return the turn about the centre of the object."""
        return Turn(Rotation.from_rotvec(self.values[4:]), np.zeros((3, 3)))


STAY = Move(np.zeros(7), irradiance_holds=False)
EVERY = slice(None)
"""All pixels of the sample."""


class _Search:
    """The search for the move of the near lights that explains the readings."""

    def __init__(self, given: SolveInput, lights: PlacedLights) -> None:
        self.sample = near_sample(given.camera, given.mask, given.stack, lights)
        self.near = lights.place[:, 3] == 1
        places = lights.place[self.near, :3]
        self.span = float(np.linalg.norm(places[:, None] - places, axis=2).max(initial=0))
        self.away = float(np.median(np.linalg.norm(places - lights.centre, axis=1))) if len(places) else 0.0
        self._depth = self.sample.top - mean_height(given.camera)
        self._centre = lights.centre

    @property
    def possible(self) -> bool:
        """Return whether there are enough lights and readings to tell."""
        told = self.sample.usable.sum(axis=0) >= LEAST_LIGHTS
        return self.near.sum() >= LEAST_LIGHTS and told.sum() >= LEAST_PIXELS and self.span > 0

    def moved(self, move: Move) -> Lamps:
        """Return the lights that are moved."""
        lamps = self.sample.lamps
        turned = move.turn.of(PlacedLights.about(self._centre, lamps.place, lamps.strength[:, None], lamps.lobe))
        place, strength = turned.place.copy(), lamps.strength.copy()
        place[self.near, :3] = place[self.near, :3] * np.exp(move.values[3]) + self.span * move.values[:3]
        if move.irradiance_holds:
            before, after = (((each[self.near, :3] - self._centre)**2).sum(axis=1) for each in (lamps.place, place))
            strength[self.near] *= after / before
        return Lamps(place, strength, turned.lobe)

    def fit(self, move: Move) -> NearFit:
        """Return the normals under lights that are moved, and what they leave."""
        return surface_at(self.sample._replace(lamps=self.moved(move)), self._depth, DEVICE)

    def fit_without_falloff(self) -> NearFit:
        """Return the normals where images are divided by the falloff of each light on the plane of the surface, and what they leave."""
        lamps, mask = self.sample.lamps, self.sample.mask
        plane = self.sample.points(np.full(mask.shape, self.sample.top - self._depth))[mask]
        squares = ((lamps.place[:, None, :3] - plane) ** 2).sum(axis=2)
        taken = np.where(self.near[:, None], squares / squares.mean(axis=1, keepdims=True), 1)
        return surface_at(self.sample._replace(readings=self.sample.readings / taken), self._depth, DEVICE)

    def best(self) -> Move:
        """Return the move that leaves least, with a turn only where that takes clearly more away than moves."""
        (cost, move), (less, other) = (self.searched(turned=turned) for turned in (False, True))
        gain = (cost - less) / (cost + QUIET)
        clear = gain > LEAST_GAIN and other.turn.right.magnitude() > (LEAST_TURN if gain > CLEAR_GAIN else LEAST_TURN_UNCLEAR)
        return other if clear else move

    def searched(self, counted: np.ndarray | slice = EVERY, *, turned: bool) -> tuple[float, Move]:
        """Return the mean cost and the move that leaves least, with a turn or without. `counted`: [pixels] bool, whose readings count."""
        count = 7 if turned else 4

        def found(holds: bool) -> tuple[float, Move]:
            def cost(values: np.ndarray) -> float:
                return float(cost_of(self.fit(Move(np.pad(values, (0, 7 - count)), holds)))[counted].mean())

            best = minimize(cost, np.zeros(count), method="Nelder-Mead", options={
                "initial_simplex": np.vstack([np.zeros(count), np.diag([STEP] * 4 + [ANGLE] * 3)[:count, :count]]), "adaptive": turned,
                "maxfev": MOST_FITS_TURNED if turned else MOST_FITS, "xatol": LENGTH, "fatol": COST})
            return float(best.fun), Move(np.pad(best.x, (0, 7 - count)), holds)

        return min((found(holds) for holds in ((False,) if turned else (False, True))), key=lambda one: one[0])

    def facts(self, move: Move) -> dict[str, Any]:
        """Return a move as the report has it."""
        return {"moved_m": [float(f"{metres:.4g}") for metres in self.span * move.values[:3]],
                "factor": float(f"{np.exp(move.values[3]):.5g}"), **({"turn_degrees": move.turn.facts()["turn_degrees"]} if move.is_turned
                                                                     else {})}

    def at_all_pixels(self, given: SolveInput, values: np.ndarray) -> np.ndarray:
        """Return errors that are known at the sampled pixels [pixels] at all pixels of the image."""
        return at_all_pixels(given.mask, self.sample.pixels(given.mask.shape[1]), values)


def find_placement(given: SolveInput, lights: PlacedLights) -> Placement | None:
    """Return where all near lights stand together, None where nothing speaks against the declared places."""
    search = _Search(given, lights)
    if not search.possible:
        return None
    declared = search.fit(STAY)
    before = cost_of(declared)
    trials = [(unit, search.fit(Move(np.log(metres) * np.eye(7)[3], holds))) for unit, metres in UNITS.items() for holds in (False, True)]
    unit, other = min(trials, key=lambda trial: cost_of(trial[1]).mean())
    if cost_of(other).mean() < OTHER_UNIT * before.mean() and np.median(before) > LEAST_COST:
        return Placement(
            f"frames[].light.position_m: the near lights are said to stand {search.away:.3g} m from the object, and the readings fit if "
            f"these positions are in {unit}: give them in metres", {"unit": unit},
            search.at_all_pixels(given, degrees_between(declared.normal, other.normal)))
    steps = [Move(step, holds) for step in PROBE * np.vstack([np.eye(4, 7), -np.eye(4, 7)]) for holds in (False, True)]
    least = float(before.mean()) - LEAST_SLOPE * (float(before.mean()) + QUIET)
    if not any(cost_of(search.fit(step)).mean() < least for step in steps):
        return None
    found = search.best()
    moved = search.fit(found)
    after = cost_of(moved)
    gain = float((before - after).mean()) / (float(before.mean()) + QUIET)
    less = np.bincount(squares_of(search.sample.mask), weights=before - after)
    if not found.plausible or np.median(after) > EXPLAINED or gain < LEAST_GAIN or less.sum() < SURE * np.sqrt((less**2).sum()):
        return None
    level = search.fit_without_falloff()
    level_cost = cost_of(level).mean()
    if level_cost < after.mean():
        left = float(level_cost / (before.mean() + QUIET))
        return Placement(
            "frames[].light: the images look as if the falloff of near lights (1/r²) was taken out of them already, as by flat fields or a "
            f"correction: without it the readings cost {100 * (1 - left):.0f} % less, more than with moved lights; give images as the "
            "camera took them, or declare the lights distant", {"falloff_taken_out": True},
            search.at_all_pixels(given, degrees_between(declared.normal, level.normal)))
    way, factor = search.span * found.values[:3], float(np.exp(found.values[3]))
    words = ", ".join(f"{length:+.3f}" for length in way)
    turned, axes = ("", "") if not found.is_turned else (f"turned {found.turn.words()} through the object, ", "axes, ")
    return Placement(
        f"frames[].light.position_m: the near lights look {turned}moved by ({words}) m and {factor:.3g} times as far from the origin; the "
        f"readings then cost {100 * gain:.0f} % less: check {axes}origin and scale of the positions, camera.surface_z_m, "
        "camera.pixel_size_m, and that no light of the room is in the images; or take them as found (--lights refined)",
        search.facts(found), search.at_all_pixels(given, degrees_between(declared.normal, moved.normal)))


def refine_places(given: SolveInput, lights: PlacedLights) -> RefinedPlaces:
    """Move all near lights together until they explain the images, and turn them where these say that they are turned.
    Raises CalibrationError: the images do not tell where they stand."""
    search = _Search(given, lights)
    if not search.possible:
        raise CalibrationError(f"--lights refined: {int(search.near.sum())} near lights do not tell where they stand: {LEAST_LIGHTS} or "
                               f"more are needed, and {LEAST_PIXELS} pixels that each are lit by as many")
    found = search.best()
    if not found.plausible:
        raise CalibrationError("--lights refined: the images fit best under lights that stand somewhere else altogether: check "
                               "frames[].light.position_m, their order and axes")
    square = squares_of(search.sample.mask)
    even = (square // SQUARES + square) % 2 == 0  # as on a chessboard
    # twice what noise leaves, for what both halves share
    left = degrees_between(*(search.fit(search.searched(own, turned=found.is_turned)[1]).normal for own in (even, ~even)))
    lamps = search.moved(found)
    ratio = lamps.strength / search.sample.lamps.strength
    if not found.irradiance_holds:  # then as strong at the origin as before, on the whole
        ratio = np.where(search.near, np.exp(2 * found.values[3]), 1.0)
    facts = {**search.facts(found), "irradiance_holds": found.irradiance_holds, "left_degrees": round(float(np.median(left)), 3)}
    moved = PlacedLights.about(lights.centre, lamps.place, lights.strength * ratio[:, None], lamps.lobe)
    doubt = search.at_all_pixels(given, left)
    turn = None
    for _ in range(MOST_TURNS):
        again = turn_of(given, moved)
        if again is None:
            break
        moved, turn = again.of(moved), again.after(turn)
    if turn is None:
        return RefinedPlaces(moved, doubt, {"refined_lights": facts}, ())
    return RefinedPlaces(moved, np.hypot(doubt, np.float32(turn.sigma_degrees)),
                         {"refined_lights": facts, "light_turn": turn.facts()}, (f"frames[].light.position_m: {turn.undone()}",))
