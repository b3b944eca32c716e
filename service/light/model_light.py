"""What lights a frame → samples of light for a model of the surface, and which of them throw sharp shadows."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from kernels.relight.around import lights_around
from kernels.relight.discs import disc_samples
from kernels.relight.environment_sources import EnvironmentSamples, sample_environment
from kernels.relight.marching import grouped
from kernels.relight.sources import NEVER, Sources, far, join
from service.light.environments import Environments
from service.light.schedule import FrameLighting
from stage.colour import rgb_matrix
from stage.point_lights import DistantLights

SHARP_RADIUS_DEGREES = 2.0
"""Samples of a map as small as this come from where it is bright; light from there throws shadows of its own. Other samples are shadowed as
the captured lights around them are."""
MARCHES = 24
"""Directions that are marched for one frame at the most: for a sun of 3°, steps of a penumbra of 4 %."""
GROUP_REACH_DEGREES = 2.0


class ModelLight(NamedTuple):
    """Light of one frame, as the model of the surface takes it."""

    wanted: Sources
    """What should light it."""
    captured: Sources
    """The captured lights with the energy that the plain sum gives them."""
    marched: np.ndarray  # [groups, 4] places whose visibility follows after that of the captured lights


class LightModel:
    """Makes the light of frames."""

    def __init__(self, lights: DistantLights, environments: Environments | None, space: str) -> None:
        """Args: lights: captured ones; environments: that maps are read from; space: scene-linear, of the frames.

        Raises:
            ArrayError: fewer than four lights, or all in one plane.
        """
        self._lights, self._environments, self._space = lights, environments, space
        self._map: tuple[Path, EnvironmentSamples] | None = None
        lights_around(lights.direction, lights.direction[:1])

    def light(self, lighting: FrameLighting, energy: np.ndarray) -> ModelLight:
        """The light of one frame.

        Args:
            lighting: of the frame; captured images that it adds are exact and have no part in it.
            energy: [lights, 3] that environment and discs give each captured light.
        """
        parts, sharp = [far(np.zeros((0, 3)), np.zeros((0, 3)))], [np.zeros(0, dtype=bool)]
        if lighting.sky is not None and self._environments is not None:
            samples = self._samples(lighting.sky.path)
            parts.append(far(samples.direction @ lighting.sky.rotation.T, samples.energy * 2.0**lighting.sky.stops))
            sharp.append(samples.radius < np.radians(SHARP_RADIUS_DEGREES))
        for disc in lighting.discs:
            directions = disc_samples(disc.direction, disc.angle_degrees)
            irradiance = np.maximum(rgb_matrix(disc.color_space, self._space) @ disc.irradiance, 0)
            whole = irradiance * 2 / (1 + np.cos(np.radians(disc.angle_degrees / 2)))
            parts.append(far(directions, np.tile(whole / len(directions), (len(directions), 1))))
            sharp.append(np.full(len(directions), True))
        count = len(self._lights.direction)
        wanted = join(parts)
        around, share = lights_around(self._lights.direction, wanted.place[:, :3].astype(np.float64))
        wanted, marched = grouped(wanted._replace(occluder=around, share=share), np.concatenate(sharp), count, most=MARCHES,
                                  reach=np.radians(GROUP_REACH_DEGREES))
        return ModelLight(wanted, self.captured(energy), marched)

    def captured(self, energy: np.ndarray) -> Sources:
        """The captured lights with these energies [lights, 3], each hidden by what hides it."""
        itself = np.full((len(energy), 3), NEVER, np.int32)
        itself[:, 0] = np.arange(len(energy))
        return far(self._lights.direction, energy)._replace(occluder=itself)

    def _samples(self, path: Path) -> EnvironmentSamples:
        if self._map is None or self._map[0] != path:
            assert self._environments is not None
            self._map = (path, sample_environment(self._environments.read(path, self._space)))
        return self._map[1]
