"""What a picture should be: under one lamp, the prediction from the lamps around it; under several, the median of those of equal levels."""

from typing import NamedTuple

import numpy as np

from service.acquisition.checks.fault import Fault
from service.acquisition.checks.motion import Bands
from service.acquisition.checks.prediction import prediction_weights, rough_weights
from service.acquisition.checks.sample import Sample
from service.acquisition.plans.shots import Shot

LEAST_MISFIT = 1e-4
"""A misfit below this is as good as none."""
LEAST_WEIGHT = 1e-3
"""Pictures with less weight are left out of a prediction."""


class Seen(NamedTuple):
    """A picture that a shot has."""

    shot: Shot
    sample: Sample
    root: np.ndarray  # [blocks] the square roots of the sample's blocks, of unit length: highlights count little
    bands: Bands
    faults: tuple[Fault, ...]


class Expectation:
    """Says what pictures under the lamps of a rig should be."""

    def __init__(self, directions: np.ndarray) -> None:
        """Take the directions of the lamps, [lamps, 3]."""
        self.directions = directions

    def weights(self, seen: Seen, others: list[Seen]) -> list[tuple[np.float32, Seen]] | None:
        """Return the weights of those pictures whose sum is expected under a lamp, or None."""
        if seen.shot.lamp is None:
            return [(np.float32(1 / len(others)), each) for each in others] or None
        wanted, directions = self.directions[seen.shot.lamp], self.towards(others)
        weights = prediction_weights(wanted, directions)
        if weights is None:
            weights = rough_weights(wanted, directions)
        if weights is None:
            return None
        return [(np.float32(weight), each) for weight, each in zip(weights, others, strict=True) if abs(weight) > LEAST_WEIGHT]

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
        return np.asarray(self.directions[np.array([each.shot.lamp for each in pictures], dtype=np.intp)])


def expected_blocks(used: list[tuple[np.float32, Seen]]) -> np.ndarray:
    """Return the expected means of blocks; of equal pictures the median, which one with a fault does not mislead."""
    if used[0][1].shot.lamp is None:
        return np.asarray(np.median([each.sample.blocks for _, each in used], axis=0))
    return np.maximum(np.sum([weight * each.sample.blocks for weight, each in used], axis=0), 0)


def expected_bands(used: list[tuple[np.float32, Seen]]) -> Bands:
    """Return the expected details."""
    if used[0][1].shot.lamp is None:
        return Bands(*(np.median([each.bands[band] for _, each in used], axis=0) for band in (0, 1)))
    return Bands(*(np.sum([weight * each.bands[band] for weight, each in used], axis=0) for band in (0, 1)))


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
    if not comparable(shot, other) or (shot.lamp is None) != (other.lamp is None) or shot.projected:
        return False
    return shot.lamp is not None or (bool(np.array_equal(shot.levels, other.levels)) and shot.light == other.light)
