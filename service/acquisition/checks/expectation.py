"""The picture that is expected, and the faults that a picture can have.

Under one lamp the prediction from the lamps around it is expected; under several, the median of pictures of equal levels.

Per pixel, the light of a distant lamp is linear in the unit vector towards it where a matte surface faces it; near the borders of shadows
it is so over small angles only. So the prediction at a direction is a fit, linear in the vector, to the pictures of the lamps, weighted by
their distance on the sphere (local linear regression, Cleveland 1979). It is linear in the pictures, and the weights follow from directions
alone.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from service.acquisition.checks.motion import Bands
from service.acquisition.checks.picture_sample import Sample
from service.acquisition.plans.shots import Shot
from service.requests.base.base import Choice

LEAST_MISFIT = 1e-4
"""A misfit below this is as good as none."""
LEAST_WEIGHT = 1e-3
"""Pictures with less weight are left out of a prediction."""
LEAST_LAMPS = 8
"""The fewest lamps from which a picture is predicted."""
WIDTH_SPACINGS = 1.2
"""The standard deviation of the weights over the distance to the fourth nearest lamp."""
NEIGHBOUR = 4
MOST_CONDITION = 1e6
MOST_GAIN = 2.0
"""The largest sum of the sizes of weights: beyond it the direction lies outside of those of the lamps, an extrapolation."""
FAR_DEGREES = 45.0
"""The largest angle to the fourth nearest lamp at which the lamps on one side say roughly what a picture should be."""
EXPECTED_GAIN = 0.02
"""The weight, over that of the picture, with which the part of the prediction is held at 1: under lamps near the camera the
prediction is like the usual picture, and the two parts could stand for one another."""
SHADE_PART = 0.1
"""The reading, as a part of the mean one, below which errors of the prediction count no less."""


class FaultKind(Choice):
    """The kind of a fault of a picture."""

    CLIPPED = "clipped", "too many readings of the object are at full scale"
    DARK = "too_dark", "the brightest readings are near the noise"
    BRIGHT = "too_bright", "the picture has far more light than those of the lamps around it"
    UNLIT = "did_not_light", "the light did not come on"
    WRONG_LIGHT = "wrong_light", "another light shone than the plan says"
    DOUBLED = "doubled", "the picture is one that was taken before"
    MISSING = "missing", "no picture came"
    LATE = "late", "a picture came when none was asked for"
    MOVED = "moved", "the object or the camera moved"
    UNSHARP = "focus", "the focus fell off"
    AMBIENT = "ambient", "light that is not the rig's changed"


class Fault(NamedTuple):
    """A fault of the picture of one shot."""

    shot: str
    """The key of the shot."""
    kind: FaultKind
    sentence: str
    """What was found, with its figures."""


def said(faults: Sequence[Fault]) -> dict[str, list[list[str]]]:
    """Return what a line of the journal says of the faults of a picture."""
    return {"faults": [[str(fault.kind), fault.sentence] for fault in faults]} if faults else {}


class Seen(NamedTuple):
    """A picture that a shot has."""

    shot: Shot
    sample: Sample
    root: np.ndarray  # [blocks] the square roots of the sample's blocks, of unit length: highlights count little
    bands: Bands
    faults: tuple[Fault, ...]


class Expectation:
    """Says what pictures under the lamps of a rig should be."""

    def __init__(self, directions: np.ndarray, light: np.ndarray) -> None:
        """Take the directions of the lamps, [lamps, 3], and the irradiance that each gives, [lamps], in any unit."""
        self.directions, self._light = directions, light

    def weights(self, seen: Seen, others: list[Seen]) -> list[tuple[np.float32, Seen]] | None:
        """Return the weights of those pictures whose sum is expected under a lamp, or None."""
        if seen.shot.lamp is None:
            return [(np.float32(1 / len(others)), each) for each in others] or None
        shares = self.shares(seen, others)
        if shares is None:
            return None
        light = self._light[seen.shot.lamp] / self._light[_lamps(others)]
        return [(np.float32(share * factor), each) for share, factor, each in zip(shares, light, others, strict=True)
                if abs(share) > LEAST_WEIGHT]

    def shares(self, seen: Seen, others: list[Seen]) -> np.ndarray | None:
        """Return the weights of the pictures under other lamps, as if all gave equal light, [others]; None where they say nothing."""
        wanted, directions = self.directions[seen.shot.lamp], self.towards(others)
        weights = prediction_weights(wanted, directions)
        return rough_weights(wanted, directions) if weights is None else weights

    def misfit(self, seen: Seen, others: list[Seen]) -> float:
        """Return how far a picture is from what is expected of it, 0 to 1."""
        used = self.weights(seen, others)
        return 0.0 if used is None else 1 - float(seen.root @ unit_root(expected_blocks(used)))

    def interpolated(self, seen: Seen, others: list[Seen]) -> bool:
        """Return whether other lamps stand all around that of a picture."""
        assert seen.shot.lamp is not None
        return prediction_weights(self.directions[seen.shot.lamp], self.towards(others)) is not None

    def towards(self, pictures: list[Seen]) -> np.ndarray:
        """Return the directions of the lamps of pictures, [pictures, 3]."""
        return np.asarray(self.directions[_lamps(pictures)])


def _lamps(pictures: list[Seen]) -> np.ndarray:
    """Return the indices of the lamps of pictures, [pictures]."""
    return np.array([each.shot.lamp for each in pictures], dtype=np.intp)


def expected_blocks(used: list[tuple[np.float32, Seen]]) -> np.ndarray:
    """Return the expected means of blocks; of equal pictures the median, which one with a fault does not mislead."""
    if used[0][1].shot.lamp is None:
        return np.asarray(np.median([each.sample.blocks for _, each in used], axis=0))
    return np.maximum(np.sum([weight * each.sample.blocks for weight, each in used], axis=0), 0)


def expected_bands(used: list[tuple[np.float32, Seen]]) -> Bands:
    """Return the expected details."""
    bands = range(len(Bands._fields))
    if used[0][1].shot.lamp is None:
        return Bands(*(np.median([each.bands[band] for _, each in used], axis=0) for band in bands))
    return Bands(*(np.sum([weight * each.bands[band] for weight, each in used], axis=0) for band in bands))


def added_part(blocks: np.ndarray, expected: np.ndarray, usual: np.ndarray) -> float:
    """Return the part b of the usual picture in a picture that is fitted as g expected + b usual, relative errors alike and g near 1."""
    weight = 1 / (expected + SHADE_PART * usual.mean())
    seen = usual > 2 * SHADE_PART * usual.mean()
    columns, found = np.column_stack([expected * weight, usual * weight])[seen], (blocks * weight)[seen]
    normal, right = columns.T @ columns, columns.T @ found
    held = EXPECTED_GAIN * normal[0, 0]
    return float(np.linalg.solve(normal + np.diag([held, 1e-9 * normal[1, 1]]), right + np.array([held, 0]))[1])


def lower_quartile(weighted: list[tuple[np.float32, float]]) -> float:
    """Return the value below which a quarter of the weight is."""
    weights, values = (np.array(column)[np.argsort([value for _, value in weighted])] for column in zip(*weighted, strict=True))
    return float(values[np.searchsorted(weights.cumsum(), 0.25 * weights.sum())])


def unit_root(blocks: np.ndarray) -> np.ndarray:
    """Return the square roots of means of blocks, scaled to unit length."""
    found = np.sqrt(np.maximum(blocks, 0))
    return np.asarray(found / max(float(np.linalg.norm(found)), 1e-30))


def comparable(shot: Shot, other: Shot) -> bool:
    """Return whether two shots are of the same object at the same exposure."""
    return shot.folder == other.folder and shot.exposure_s == other.exposure_s


def same_kind(shot: Shot, other: Shot) -> bool:
    """Return whether the picture of a shot says what that of another one should be."""
    if not comparable(shot, other) or (shot.lamp is None) != (other.lamp is None) or shot.grey is not None:
        return False
    return shot.lamp is not None or (shot.pattern == other.pattern and bool(np.array_equal(shot.levels, other.levels))
                                     and shot.light == other.light)


def prediction_weights(wanted: np.ndarray, directions: np.ndarray) -> np.ndarray | None:
    """Return the weight of the picture of each lamp in the prediction at a direction.
    `wanted`: [3] unit vector. `directions`: [lamps, 3] unit vectors of the lamps whose pictures there are. Returns [lamps] float64, or None
    where there are too few, or all lie on one side of the direction."""
    if len(directions) < LEAST_LAMPS:
        return None
    angle = np.arccos(np.clip(directions @ wanted, -1, 1))
    width = WIDTH_SPACINGS * np.sort(angle)[NEIGHBOUR - 1]
    weight = np.exp(-0.5 * (angle / max(width, 1e-3)) ** 2)
    basis = directions @ np.column_stack([wanted, _tangents(wanted)])
    normal = basis.T @ (weight[:, None] * basis)
    if np.linalg.cond(normal) > MOST_CONDITION:
        return None
    found: np.ndarray = np.linalg.solve(normal, (weight[:, None] * basis).T)[0]
    return found if np.abs(found).sum() <= MOST_GAIN else None


def _tangents(direction: np.ndarray) -> np.ndarray:
    """Return two unit vectors across a direction, [3, 2]."""
    other = np.eye(3)[np.abs(direction).argmin()]
    first = np.cross(direction, other)
    first /= np.linalg.norm(first)
    return np.column_stack([first, np.cross(direction, first)])


def rough_weights(wanted: np.ndarray, directions: np.ndarray) -> np.ndarray | None:
    """Return weights as `prediction_weights` does, of a weighted mean, which also stands for lamps on one side; None where all are far."""
    if len(directions) < NEIGHBOUR:
        return None
    angle = np.arccos(np.clip(directions @ wanted, -1, 1))
    spacing = np.sort(angle)[NEIGHBOUR - 1]
    if spacing > np.radians(FAR_DEGREES):
        return None
    weight = np.exp(-0.5 * (angle / max(spacing, 1e-3)) ** 2)
    found: np.ndarray = weight / weight.sum()
    return found
