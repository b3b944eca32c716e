"""What lights a frame, computed once from its schedule: weights of the captured images, and the same light as samples for a model.

`far_light` reads the environment, turns it and takes discs into the working space. From its result come the weights of the captured
images (kernels.relight.environment, after Debevec et al., "Acquiring the Reflectance Field of a Human Face", SIGGRAPH 2000, section 3.3)
and the samples that a model of the surface is shaded with (kernels.relight.environment_sources). Near lights light the model alone.
"""

from collections.abc import Iterator, Mapping, Sequence
from itertools import groupby
from typing import NamedTuple

import numpy as np

from kernels.relight import sources
from kernels.relight.around import lights_around
from kernels.relight.beyond import reach, share_beyond
from kernels.relight.discs import disc_samples, integrate_discs
from kernels.relight.environment import Weighting, integrate, light_weights
from kernels.relight.marching import grouped
from kernels.relight.sample_energy import share_samples
from kernels.relight.sources import NEVER, Sources, far, join
from service.light.environments import EnvironmentMap, Environments
from service.light.schedule import Disc, ScheduledFrame
from service.requests.near_lights import PointLight, RectangleLight, SphereLight
from stage.colour import rgb_matrix
from stage.point_lights import DistantLights
from stage.stack import Stack

RUN = 256
"""Number of frames under one environment map whose weights are computed together: rotations that differ by whole samples share most of
the work."""
SHARP_RADIUS_DEGREES = 2.0
"""Largest angular radius of a map's sample that casts shadows of its own: small samples lie where the map is bright. The visibility of
other samples is interpolated from the captured lights around them."""
FAR_MARCHES = 24
"""Most directions in which shadows are marched for one frame: for a sun of 3°, its penumbra has steps of 4 %."""
FAR_REACH_DEGREES = 2.0
"""Largest angle between a sample and the direction that is marched for it."""
NEAR_MARCHES = 48
"""Number of places on an area light to which shadows are marched: its penumbra has steps of 2 %."""
ANYWHERE = 1e30
"""Reach beyond every scene: each sample of an area light takes the nearest marched place."""

NearLight = PointLight | SphereLight | RectangleLight


class FarLight(NamedTuple):
    """The environment and the discs of one frame, in the working space."""

    environment: EnvironmentMap | None
    rotation: np.ndarray  # [3, 3] float64 of the environment: turned = rotation @ direction
    gain: float
    """Factor on the radiance of the environment."""
    discs: tuple[Disc, ...]


class ModelLight(NamedTuple):
    """The light of one frame as samples, for a model of the surface."""

    wanted: Sources
    """The light that the frame should show, as far as it lies between the captured lights: of the environment and the discs."""
    captured: Sources
    """The light that the weighted sum of images already contains for it: the captured lights, with the energy that the weights give
    each."""
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


class FrameLight(NamedTuple):
    """The light of one frame, without its exposure."""

    weights: np.ndarray  # [3, lights padded] float32: what each stored image is multiplied by
    model: ModelLight | None
    """The same light for a model of the surface; None: no model is lit."""
    share_beyond: float
    """Share of the energy of the environment and the discs, 0…1, that comes from twice the reach of the captured lights and farther."""


class NearLights(NamedTuple):
    """Near lights as samples."""

    fine: Sources
    """Samples for a model of the surface, with rows of visibility."""
    coarse: Sources
    """Fewer samples, for sums of captured images."""
    marched: np.ndarray  # [rows, 4] places of the rows of visibility


class FarSamples(NamedTuple):
    """Far light as samples."""

    direction: np.ndarray  # [n, 3] float64 unit vectors
    energy: np.ndarray  # [n, 3] float64 ∫ L dω
    sharp: np.ndarray  # [n] bool: casts shadows of its own

    def scaled(self, part: np.ndarray) -> "FarSamples":
        """Return the samples with a part [n] of their energy, without those that have none."""
        kept = part > 0
        return FarSamples(self.direction[kept], self.energy[kept] * part[kept, None], self.sharp[kept])


class CaptureLighting:
    """Resolves the light of the frames of one capture."""

    def __init__(self, lights: DistantLights, stack: Stack, environments: Environments | None, space: str, *, weighting: Weighting,
                 device: str, with_model: bool) -> None:
        """Keep what the frames of the capture have in common.

        Args:
            lights: the captured lights.
            stack: the captured images.
            environments: where the environment maps of frames are read from.
            space: the scene-linear space of the stack.
            weighting: how light from between the captured lights is shared out over them.
            device: where maps are shared out.
            with_model: whether a model of the surface is lit too.
        """
        self._lights, self._stack, self._environments, self._space = lights, stack, environments, space
        self._weighting, self._device, self._with_model = weighting, device, with_model

    @property
    def beyond_degrees(self) -> float:
        """Return the least angle from every captured light, in degrees, of light that counts in `FrameLight.share_beyond`."""
        return float(np.degrees(2 * reach(self._lights.direction)))

    def frames(self, scheduled: Sequence[ScheduledFrame]) -> Iterator[FrameLight]:
        """Yield the light of each frame; a map is read when its first frame comes.

        Raises:
            StageError, KernelError: a map cannot be used; names it.
        """
        for _, group in groupby(scheduled, key=lambda frame: None if frame.environment is None else frame.environment.path):
            members = list(group)
            for begin in range(0, len(members), RUN):
                yield from self._run(members[begin : begin + RUN])

    def _run(self, scheduled: Sequence[ScheduledFrame]) -> Iterator[FrameLight]:
        """Yield the light of frames under one environment map, or under none."""
        resolved = [far_light(frame, self._environments, self._space) for frame in scheduled]
        images = [{self._stack.frames.index(image): weight for image, weight in frame.captured.items()} for frame in scheduled]
        weights = self._weights(resolved)
        for each, light, captured in zip(weights, resolved, images, strict=True):
            for index, weight in captured.items():
                each[:, index] += weight * self._stack.scale[index]
            samples = far_samples(light)
            beyond = share_beyond(self._lights.direction, samples.direction)
            yield FrameLight(each, self._model_light(samples, beyond, each, captured) if self._with_model else None,
                             float(samples.energy[beyond >= 1].sum() / max(samples.energy.sum(), np.finfo(float).tiny)))

    def _weights(self, run: Sequence[FarLight]) -> np.ndarray:
        """Return [frames, 3, lights padded] float32 weights that stand for environment and discs."""
        energy = np.zeros((len(run), len(self._lights.direction), 3))
        environment = run[0].environment
        discs = [(index, disc) for index, light in enumerate(run) for disc in light.discs]
        if environment is None and not discs:
            return np.zeros((len(run), 3, len(self._stack.scale)), dtype=np.float32)
        if environment is not None:
            given = integrate(environment.radiance, self._lights.direction, np.stack([light.rotation for light in run]),
                              weighting=self._weighting, device=self._device)
            energy += given * np.array([light.gain for light in run])[:, None, None]
        if discs:
            shares = integrate_discs(np.stack([disc.direction for _, disc in discs]),
                                     np.array([disc.angle_degrees for _, disc in discs]), self._lights.direction,
                                     weighting=self._weighting)
            for (index, disc), share in zip(discs, shares, strict=True):
                energy[index] += share[:, None] * disc.irradiance
        return light_weights(energy, self._lights.irradiance, self._stack.scale)

    def _model_light(self, samples: FarSamples, beyond: np.ndarray, weights: np.ndarray, captured: Mapping[int, float]) -> ModelLight:
        """Return the light of one frame for a model.

        Args:
            samples: of the light.
            beyond: [samples] how far each lies beyond the captured lights.
            weights: [3, lights padded] of the stored images.
            captured: how much of which captured image the frame adds.
        """
        directions, irradiance = self._lights.direction, self._lights.irradiance
        count = len(directions)
        scale = np.asarray(self._stack.scale[:count], dtype=np.float64)
        # from the float32 weights and not from the energy, so that the model subtracts exactly what the sum of images added
        shares = np.divide(weights[:, :count].T, scale[:, None], out=np.zeros((count, 3)), where=scale[:, None] > 0)
        added = np.zeros((count, 3))
        for index, weight in captured.items():
            shares[index] -= weight
            added[index] += weight * irradiance[index]
        given = shares * irradiance
        outside = None
        if (beyond > 0).any():
            part = samples.scaled(beyond)
            # share_kernel leaves light from beyond to share_smooth
            sharing = Weighting.SMOOTH if self._weighting is Weighting.KERNEL else self._weighting
            stands_in = share_samples(part.direction, part.energy, directions, weighting=sharing)
            outside = LightBeyond(_hidden(part, directions), captured_lights(directions, stands_in))
            samples, given = samples.scaled(1 - beyond), given - stands_in
        wanted, marched = light_samples(samples, directions)
        return ModelLight(wanted, captured_lights(directions, given), outside,
                          captured_lights(directions, added) if captured else None, marched)


def far_light(frame: ScheduledFrame, environments: Environments | None, space: str) -> FarLight:
    """Return the environment and the discs of a frame in a working space.

    Args:
        frame: of a schedule.
        environments: where its environment map is read from.
        space: scene-linear.

    Raises:
        ImageError: the map has impossible values (counted), or a colour space that is not known.
        StorageError: the map cannot be read.
    """
    discs = tuple(disc._replace(irradiance=np.maximum(rgb_matrix(disc.color_space, space) @ disc.irradiance, 0), color_space=space)
                  for disc in frame.discs if any(disc.irradiance))  # a colour outside the working space's gamut has a negative channel
    if frame.environment is None or environments is None:
        return FarLight(None, np.eye(3), 1.0, discs)
    turned = frame.environment
    return FarLight(environments.read(turned.path, space), turned.rotation, 2.0**turned.exposure_stops, discs)


def far_samples(light: FarLight) -> FarSamples:
    """Return the environment and the discs of one frame as samples."""
    directions, energy, sharp = [np.zeros((0, 3))], [np.zeros((0, 3))], [np.zeros(0, dtype=bool)]
    if light.environment is not None:
        samples = light.environment.samples
        directions.append(samples.direction @ light.rotation.T)
        energy.append(samples.energy * light.gain)
        sharp.append(samples.radius < np.radians(SHARP_RADIUS_DEGREES))
    for disc in light.discs:
        towards = disc_samples(disc.direction, disc.angle_degrees)
        whole = disc.irradiance * 2 / (1 + np.cos(np.radians(disc.angle_degrees / 2)))
        directions.append(towards)
        energy.append(np.tile(whole / len(towards), (len(towards), 1)))
        sharp.append(np.full(len(towards), True))
    return FarSamples(np.concatenate(directions), np.concatenate(energy), np.concatenate(sharp))


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
    return grouped(_hidden(samples, directions), samples.sharp, len(directions), most=FAR_MARCHES, reach=np.radians(FAR_REACH_DEGREES))


def near_lights(lights: Sequence[NearLight], first_row: int) -> NearLights:
    """Return near lights as samples.

    Args:
        lights: in the camera frame; any number.
        first_row: the first row of visibility that is theirs.
    """
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


def captured_lights(directions: np.ndarray, energy: np.ndarray) -> Sources:
    """Return the captured lights as samples of these energies [lights, 3], each hidden by what hides it."""
    own_row = np.full((len(energy), 3), NEVER, np.int32)
    own_row[:, 0] = np.arange(len(energy))
    return far(directions, energy)._replace(occluder=own_row)


def _hidden(samples: FarSamples, directions: np.ndarray) -> Sources:
    """Return samples hidden as the captured lights around them are."""
    whole = far(samples.direction, samples.energy)
    around, share = lights_around(directions, whole.place[:, :3].astype(np.float64))
    return whole._replace(occluder=around, share=share)
