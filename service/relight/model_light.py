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

MOST_SAMPLES = 4096
"""The most samples of an area light: on a square they are a 64th of its side apart."""
WORTH_SAYING = 1e-3
"""The part of the surface from which on it is said that it is nearer to an area light than the light's samples are apart."""

REMOTE, FAINT = 100.0, 1e-3
"""How many times as far as the camera a near light is, and below what irradiance, where it is said: positions in millimetres put a light a
thousand times too far, where its irradiance is a millionth; a far light that is meant is as much stronger."""

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
    doubts: tuple[str, ...]
    """A sentence for each light that the surface is too close to."""


def near_lights(lights: Sequence[NearLight], first_row: int, surface: np.ndarray) -> NearLights:
    """Return near lights of the camera frame as samples, whose rows of visibility begin at `first_row`.

    Args:
        surface: [n, 3] places that are lit. Samples of an area light are half as far apart as the nearest of them is from it, as far as
            MOST_SAMPLES allow: their sum is within 2 % of the integral then, under the border of a rectangle; twice as far apart, 8 %.
    """
    nothing = far(np.zeros((0, 3)), np.zeros((0, 3)))
    fine, coarse, marched, doubts = [nothing], [nothing], [np.zeros((0, 4), np.float32)], []
    for light in lights:
        doubts += _remote(light, surface)
        if isinstance(light, PointLight):
            axis = None if light.axis is None else np.array(light.axis) / np.linalg.norm(light.axis)
            all_samples = few = sources.point(np.array(light.position_m), np.array(light.intensity), axis, light.anisotropy)
        else:
            all_samples, doubt = _fine_samples(light, surface)
            few = _area_samples(light, sources.FEW)
            doubts += [] if doubt is None else [doubt]
        samples, places = grouped(all_samples, np.ones(all_samples.count, dtype=bool), first_row, most=NEAR_MARCHES, reach=ANYWHERE)
        first_row += len(places)
        fine.append(samples)
        coarse.append(few)
        marched.append(places)
    return NearLights(join(fine), join(coarse), np.concatenate(marched), tuple(doubts))


def _fine_samples(light: SphereLight | RectangleLight, surface: np.ndarray) -> tuple[Sources, str | None]:
    """Return samples of an area light as far apart as the surface asks for, and a sentence where it is nearer than they are apart."""
    area, distance = _extent(light, surface)
    fewest = sources.SPHERE_SAMPLES if isinstance(light, SphereLight) else sources.RECTANGLE_SAMPLES
    with np.errstate(divide="ignore"):  # a surface that touches the light
        count = int(np.clip(4 * area / distance.min() ** 2, fewest, MOST_SAMPLES))
    samples = _area_samples(light, count)
    pitch = np.sqrt(area / samples.count)
    close = float((distance < pitch).mean())
    if close <= WORTH_SAYING:
        return samples, None
    return samples, (f"{close:.1%} of the surface is within {pitch:.2g} m of an area light at {light.center_m}, nearer than its samples "
                     "are apart: its light shows them there")


def _remote(light: NearLight, surface: np.ndarray) -> list[str]:
    """Return the sentence about a light that is so far from the surface that hardly any of its light arrives."""
    if isinstance(light, PointLight):
        place, strength = light.position_m, max(light.intensity)
        distance = np.linalg.norm(surface - np.array(place), axis=1).min()
    else:
        area, distances = _extent(light, surface)
        place, strength, distance = light.center_m, max(light.radiance) * area, distances.min()
    reach = np.linalg.norm(surface, axis=1).max()
    if distance <= REMOTE * reach or strength >= FAINT * distance**2:
        return []
    return [f"the light at {place} is {distance / reach:.0f} times as far from the object as the camera's origin, and its irradiance there "
            f"is {strength / distance**2:.1g}: give places in the unit of the maps, metres where they have a scale, not millimetres"]


def _area_samples(light: SphereLight | RectangleLight, count: int) -> Sources:
    if isinstance(light, SphereLight):
        return sources.sphere(np.array(light.center_m), light.radius_m, np.array(light.radiance), count)
    return sources.rectangle(np.array(light.center_m), np.array(light.edge_u_m), np.array(light.edge_v_m), np.array(light.radiance), count)


def _extent(light: SphereLight | RectangleLight, surface: np.ndarray) -> tuple[float, np.ndarray]:
    """Return the area of a light, and the distances [n] of places [n, 3] from it."""
    away = surface - np.array(light.center_m)
    if isinstance(light, SphereLight):
        return 4 * np.pi * light.radius_m**2, np.abs(np.linalg.norm(away, axis=1) - light.radius_m)
    edges = np.array([light.edge_u_m, light.edge_v_m])
    lengths = np.linalg.norm(edges, axis=1)
    along = away @ (edges / lengths[:, None]).T
    beyond = along - np.clip(along, -lengths / 2, lengths / 2)
    return float(lengths.prod()), np.sqrt(np.maximum((away**2).sum(axis=1) - (along**2).sum(axis=1), 0) + (beyond**2).sum(axis=1))
