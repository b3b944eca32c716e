"""The light of one frame, and near lights, as samples for a model of the surface that is shaded with each of them."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from kernels.relight.model import sources
from kernels.relight.model.sources import Sources, far, grouped, join
from service.relight.far_light import FarSamples, captured_lights, hidden_as_captured
from service.relight.weights.weighting import share_samples
from service.requests.relight import LightWeights
from service.requests.shade import PointLight, RectangleLight, SphereLight

FAR_MARCHES = 24
"""Most directions in which shadows are marched for one frame: for a sun of 3°, its penumbra has steps of 4 %."""
FAR_REACH_DEGREES = 2.0
"""Largest angle between a sample and the direction that is marched for it."""
NEAR_MARCHES = 48
"""Number of places on an area light to which shadows are marched: its penumbra has steps of 2 %."""
ANYWHERE = 1e30
"""Reach beyond every scene: each sample of an area light takes the nearest marched place."""

NearLight = PointLight | SphereLight | RectangleLight


class CapturedEnergy(NamedTuple):
    """The weights of the captured images in a frame, as energy of their lights."""

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
    """Light from beyond the captured lights (kernels.relight.model.beyond)."""

    wanted: Sources
    """The light; what hides it is what hides the captured lights nearest to it, because no image shows shadows of such light."""
    captured: Sources
    """The captured lights that represent it in the weighted sum of images."""


def model_light(samples: FarSamples, beyond: np.ndarray, energy: CapturedEnergy, directions: np.ndarray,
                weighting: LightWeights) -> ModelLight:
    """Return the light of one frame.

    Args:
        samples: of the environment and the discs.
        beyond: [samples] how far each lies beyond the captured lights.
        directions: [lights, 3] unit vectors to the captured lights.
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


def weighting_beyond(weighting: LightWeights) -> LightWeights:
    """Return how light from beyond the captured lights is shared out over them: share_kernel leaves it to share_smooth."""
    return LightWeights.SMOOTH if weighting is LightWeights.KERNEL else weighting


def light_samples(samples: FarSamples, directions: np.ndarray) -> tuple[Sources, np.ndarray]:
    """Return far light for a model, and the directions in which sharp shadows are marched for it.

    Args:
        directions: [lights, 3] unit vectors whose visibility has the first rows; samples that throw no sharp shadow take it.

    Returns:
        The samples, and [groups, 4] directions of the rows of visibility that follow.
    """
    return grouped(hidden_as_captured(samples, directions), samples.sharp, len(directions), most=FAR_MARCHES,
                   reach=np.radians(FAR_REACH_DEGREES))


class NearLights(NamedTuple):
    """Near lights as samples."""

    fine: Sources
    """Samples for a model of the surface, with rows of visibility."""
    coarse: Sources
    """Fewer samples, for sums of captured images."""
    marched: np.ndarray  # [rows, 4] places of the rows of visibility


def near_lights(lights: Sequence[NearLight], first_row: int) -> NearLights:
    """Return near lights of the camera frame as samples, whose rows of visibility begin at `first_row`."""
    nothing = far(np.zeros((0, 3)), np.zeros((0, 3)))
    fine, coarse, marched = [nothing], [nothing], [np.zeros((0, 4), np.float32)]
    for light in lights:
        all_samples = _near_samples(light)
        samples, places = grouped(all_samples, np.ones(all_samples.count, dtype=bool), first_row, most=NEAR_MARCHES, reach=ANYWHERE)
        first_row += len(places)
        fine.append(samples)
        coarse.append(_near_samples(light, sources.FEW))
        marched.append(places)
    return NearLights(join(fine), join(coarse), np.concatenate(marched))


def _near_samples(light: NearLight, count: int | None = None) -> Sources:
    if isinstance(light, SphereLight):
        return sources.sphere(np.array(light.center_m), light.radius_m, np.array(light.radiance), count or sources.SPHERE_SAMPLES)
    if isinstance(light, RectangleLight):
        return sources.rectangle(np.array(light.center_m), np.array(light.edge_u_m), np.array(light.edge_v_m), np.array(light.radiance),
                                 count or sources.RECTANGLE_SAMPLES)
    axis = None if light.axis is None else np.array(light.axis) / np.linalg.norm(light.axis)
    return sources.point(np.array(light.position_m), np.array(light.intensity), axis, light.anisotropy)
