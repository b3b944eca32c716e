"""The environment and the discs of a frame: in the working space, and as samples for a model of the surface."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from kernels.relight.model.sources import Sources, disc_samples, far, own_rows
from service.relight.environments import SHARP_RADIUS_DEGREES, EnvironmentMap, Environments
from service.relight.schedule import Disc, ScheduledFrame
from service.relight.weights.triangulation import lights_around
from stage.colour.colour import rgb_matrix


class FarLight(NamedTuple):
    """The environment and the discs of one frame, in the working space."""

    environment: EnvironmentMap | None
    rotation: np.ndarray  # [3, 3] float64 of the environment: turned = rotation @ direction
    gain: float
    """Factor on the radiance of the environment."""
    discs: tuple[Disc, ...]


class FarSamples(NamedTuple):
    """Far light as samples."""

    direction: np.ndarray  # [n, 3] float64 unit vectors
    energy: np.ndarray  # [n, 3] float64 ∫ L dω
    sharp: np.ndarray  # [n] bool: casts shadows of its own

    def scaled(self, part: np.ndarray) -> "FarSamples":
        """Return the samples with a part [n] of their energy, without those that have none."""
        kept = part > 0
        return FarSamples(self.direction[kept], self.energy[kept] * part[kept, None], self.sharp[kept])

    @staticmethod
    def join(parts: Sequence["FarSamples"]) -> "FarSamples":
        """Return all samples of one part or more, in order."""
        return FarSamples(*(np.concatenate(values) for values in zip(*parts, strict=True)))


NO_SAMPLES = FarSamples(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0, dtype=bool))


def far_light(frame: ScheduledFrame, environments: Environments | None, space: str) -> FarLight:
    """Return the environment and the discs of a frame in a scene-linear working space."""
    discs = tuple(disc._replace(irradiance=np.maximum(rgb_matrix(disc.color_space, space) @ disc.irradiance, 0), color_space=space)
                  for disc in frame.discs if any(disc.irradiance))  # a colour outside the working space's gamut has a negative channel
    if frame.environment is None or environments is None:
        return FarLight(None, np.eye(3), 1.0, discs)
    turned = frame.environment
    return FarLight(environments.read(turned.path, space), turned.rotation, 2.0**turned.exposure_stops, discs)


def far_samples(light: FarLight) -> FarSamples:
    """Return the environment and the discs of one frame as samples."""
    parts = [NO_SAMPLES]
    if light.environment is not None:
        samples = light.environment.samples
        parts.append(FarSamples(samples.direction @ light.rotation.T, samples.energy * light.gain,
                                samples.radius < np.radians(SHARP_RADIUS_DEGREES)))
    return FarSamples.join([*parts, *(disc_light(disc, disc_samples(disc.direction, disc.angle_degrees)) for disc in light.discs)])


def disc_light(disc: Disc, towards: np.ndarray) -> FarSamples:
    """Return the light of a disc as samples in these directions [n, 3], which are spread evenly over it."""
    whole = disc.irradiance * 2 / (1 + np.cos(np.radians(disc.angle_degrees / 2)))
    return FarSamples(towards, np.tile(whole / len(towards), (len(towards), 1)), np.full(len(towards), True))


def captured_lights(directions: np.ndarray, energy: np.ndarray) -> Sources:
    """Return the captured lights as samples of these energies [lights, 3], each hidden by what hides it."""
    return own_rows(far(directions, energy))


def hidden_as_captured(samples: FarSamples, directions: np.ndarray) -> Sources:
    """Return samples hidden as the captured lights around them are."""
    whole = far(samples.direction, samples.energy)
    around, share = lights_around(directions, whole.place[:, :3].astype(np.float64))
    return whole._replace(occluder=around, share=share)
