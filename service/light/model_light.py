"""The light of one frame as samples, for a model of the surface that is shaded with each of them."""

from typing import NamedTuple

import numpy as np

from kernels.relight.sources import Sources, grouped
from service.light.far_light import FarSamples, captured_lights, hidden_as_captured
from service.light.weighting import Weighting, share_samples

FAR_MARCHES = 24
"""Most directions in which shadows are marched for one frame: for a sun of 3°, its penumbra has steps of 4 %."""
FAR_REACH_DEGREES = 2.0
"""Largest angle between a sample and the direction that is marched for it."""


class CapturedEnergy(NamedTuple):
    """What a frame takes of the captured images, as energy of their lights."""

    given: np.ndarray  # [lights, 3] in place of the environment and the discs
    added: np.ndarray | None  # [lights, 3] of images that light keys of type captured add; None: the frame adds none


class ModelLight(NamedTuple):
    """The light of one frame as samples, for a model of the surface."""

    wanted: Sources
    """The light that the frame should show, as far as it lies between the captured lights: of the environment and the discs."""
    captured: np.ndarray  # [lights, 3]
    """The light that the weighted sum of images already contains for it: the energy that the weights give each captured light."""
    beyond: "LightBeyond | None"
    """The rest of the environment and the discs; None: nothing lies beyond the captured lights."""
    added: Sources | None
    """The captured lights of the images that light keys of type captured add; None: the frame adds none."""
    marched: np.ndarray  # [groups, 4] directions whose visibility follows after that of the captured lights


class LightBeyond(NamedTuple):
    """Light from beyond the captured lights (kernels.relight.beyond)."""

    wanted: Sources
    """The light; what hides it is what hides the captured lights nearest to it, because no image shows shadows of such light."""
    captured: Sources
    """What stands in for it in the weighted sum of images."""


def model_light(samples: FarSamples, beyond: np.ndarray, energy: CapturedEnergy, directions: np.ndarray,
                weighting: Weighting) -> ModelLight:
    """Return the light of one frame.

    Args:
        samples: of the environment and the discs.
        beyond: [samples] how far each lies beyond the captured lights.
        energy: what the frame takes of the captured images.
        directions: [lights, 3] unit vectors to the captured lights.
        weighting: how light from between the captured lights is shared out over them.
    """
    given, outside = energy.given, None
    if (beyond > 0).any():
        part = samples.scaled(beyond)
        stands_in = share_samples(part.direction, part.energy, directions, weighting=weighting_beyond(weighting))
        outside = LightBeyond(hidden_as_captured(part, directions), captured_lights(directions, stands_in))
        samples, given = samples.scaled(1 - beyond), given - stands_in
    wanted, marched = light_samples(samples, directions)
    added = None if energy.added is None else captured_lights(directions, energy.added)
    return ModelLight(wanted, given, outside, added, marched)


def weighting_beyond(weighting: Weighting) -> Weighting:
    """Return how light from beyond the captured lights is shared out over them: share_kernel leaves it to share_smooth."""
    return Weighting.SMOOTH if weighting is Weighting.KERNEL else weighting


def light_samples(samples: FarSamples, directions: np.ndarray) -> tuple[Sources, np.ndarray]:
    """Return far light for a model, and the directions in which sharp shadows are marched for it.

    Args:
        samples: of the light of one frame.
        directions: [lights, 3] unit vectors whose visibility has the first rows; samples that throw no sharp shadow take it.

    Returns:
        The samples, and [groups, 4] directions of the rows of visibility that follow.

    Raises:
        ArrayError: fewer than four directions, or all in one plane.
    """
    return grouped(hidden_as_captured(samples, directions), samples.sharp, len(directions), most=FAR_MARCHES,
                   reach=np.radians(FAR_REACH_DEGREES))
