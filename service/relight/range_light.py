"""The light of the frames of a range, for a model of the surface whose responses to a fixed grid of directions are computed once.

Small bright places, a sun or a disc, are a few samples a frame, with shadows and highlights of their own. All other light is spread over
the directions of the grid (kernels.relight.directions.direction_grid).
"""

from functools import cached_property
from typing import NamedTuple

import numpy as np

from kernels.relight.directions.direction_grid import direction_grid, spread
from kernels.relight.model.beyond import share_beyond
from kernels.relight.model.sources import Sources, disc_samples, far
from service.relight.far_light import NO_SAMPLES, FarLight, FarSamples, disc_light, hidden_as_captured
from service.relight.model_light import CapturedEnergy, weighting_beyond
from service.relight.weights.weighting import share_samples
from service.requests.relight import LightWeights

SMALL_DISC_DEGREES = 20.0
"""Largest diameter of a disc that casts shadows of its own; the visibility of larger ones is interpolated from the captured lights."""
DISC_SAMPLES = 64
"""Samples of such a disc: 2° apart in the largest."""


class RangeLight(NamedTuple):
    """The light of one frame of a range."""

    small: Sources
    """Samples of small bright places, as far as they lie between the captured lights; each casts shadows of its own."""
    broad: np.ndarray  # [D, 3] energy of all other such light at the directions of the grid
    captured: np.ndarray  # [lights, 3] energy that the weighted sum of images already contains for it
    beyond: "RangeBeyond | None"
    """The rest of the environment and the discs; None: nothing lies beyond the captured lights."""
    added: np.ndarray | None  # [lights, 3] energy of the images that light keys of type captured add; None: the frame adds none


class RangeBeyond(NamedTuple):
    """Light from beyond the captured lights (kernels.relight.model.beyond), hidden as the captured lights nearest to it are."""

    small: Sources
    broad: np.ndarray  # [D, 3]
    captured: np.ndarray  # [lights, 3] energy that stands in for it in the weighted sum of images


class RangeLighting:
    """Resolves the light of frames for a model whose responses to the grid are known."""

    def __init__(self, directions: np.ndarray, weighting: LightWeights) -> None:
        """Keep what the frames have in common: unit vectors to the captured lights, [lights, 3], and the weighting."""
        self._directions, self._weighting = directions, weighting
        self._beyond = share_beyond(directions, direction_grid().direction)

    def light(self, light: FarLight, energy: CapturedEnergy) -> tuple[RangeLight, float]:
        """Return the light of one frame, and the share of its energy that is wholly beyond the captured lights, 0…1."""
        small, broad = _parts(light)
        grid = spread(broad.direction, broad.energy)
        outside = share_beyond(self._directions, small.direction)
        far_out = grid[self._beyond >= 1].sum() + small.energy[outside >= 1].sum()
        share = float(far_out / max(grid.sum() + small.energy.sum(), np.finfo(float).tiny))
        if not ((grid.any(axis=1) & (self._beyond > 0)).any() or (outside > 0).any()):
            return RangeLight(far(small.direction, small.energy), grid, energy.given, None, energy.added), share
        part, rest = small.scaled(outside), small.scaled(1 - outside)
        beyond = grid * self._beyond[:, None]
        stands_in = self._shares @ beyond + share_samples(part.direction, part.energy, self._directions,
                                                          weighting=weighting_beyond(self._weighting))
        return RangeLight(far(rest.direction, rest.energy), grid - beyond, energy.given - stands_in,
                          RangeBeyond(hidden_as_captured(part, self._directions), beyond, stands_in), energy.added), share

    @cached_property
    def _shares(self) -> np.ndarray:
        """Return [lights, D] how the light of the grid's directions is shared out over the captured lights."""
        towards = direction_grid().direction
        return share_samples(towards, np.eye(len(towards)), self._directions, weighting=weighting_beyond(self._weighting))


def _parts(light: FarLight) -> tuple[FarSamples, FarSamples]:
    """Return the small bright places of a frame's light, and the rest."""
    small, broad = [NO_SAMPLES], [NO_SAMPLES]
    if light.environment is not None:
        for found, parts in ((light.environment.parts.small, small), (light.environment.parts.broad, broad)):
            parts.append(FarSamples(found.direction @ light.rotation.T, found.energy * light.gain, np.full(len(found.energy), False)))
    for disc in light.discs:
        is_small = disc.angle_degrees <= SMALL_DISC_DEGREES
        towards = disc_samples(disc.direction, disc.angle_degrees, DISC_SAMPLES if is_small else None)
        (small if is_small else broad).append(disc_light(disc, towards))
    return FarSamples.join(small), FarSamples.join(broad)
