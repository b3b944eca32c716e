"""Compute the lighting of a frame once from its schedule: weights of the captured images, and the same light for a surface model.

`far_light` reads the environment, turns it and takes discs into the working space. From its result come the weights of the captured
images (service.relight.weights.weighting, after Debevec et al., "Acquiring the Reflectance Field of a Human Face", SIGGRAPH 2000, section
3.3) and the light that a model of the surface is shaded with: samples for one frame, and energy over a fixed grid of directions for a
range.
"""

from collections.abc import Iterator, Mapping, Sequence
from enum import Enum, auto
from itertools import groupby
from typing import NamedTuple

import numpy as np

from kernels.relight.model.beyond import reach, share_beyond
from service.relight.environments import Environments
from service.relight.far_light import FarLight, far_light, far_samples
from service.relight.model_light import CapturedEnergy, ModelLight, model_light
from service.relight.range_light import RangeLight, RangeLighting
from service.relight.schedule import ScheduledFrame
from service.relight.weights.weighting import integrate, integrate_discs, light_weights
from service.requests.relight import LightWeights
from stage.capture.point_lights import DistantLights
from stage.stack.stack import Stack

RUN = 256
"""Number of frames under one environment map whose weights are computed together: rotations that differ by whole samples share most of
the work."""


class ModelUse(Enum):
    """The use of a surface model: for one frame or few, or for many."""

    NONE = auto()
    FRAME = auto()
    """For one frame, or few: `FrameLight.model` has its light as samples."""
    RANGE = auto()
    """For many frames: `FrameLight.spread` has its light over a grid of directions."""


class FrameLight(NamedTuple):
    """The light of one frame, without its exposure."""

    weights: np.ndarray  # [3, lights padded] float32: what each stored image is multiplied by
    model: ModelLight | None
    """The same light for a model of the surface, in ModelUse.FRAME."""
    spread: RangeLight | None
    """The same light for a model of the surface, in ModelUse.RANGE."""
    share_beyond: float
    """Share of the energy of the environment and the discs, 0…1, that comes from twice the reach of the captured lights and farther."""


class CaptureLighting:
    """Resolves the light of the frames of one capture."""

    def __init__(self, lights: DistantLights, stack: Stack, environments: Environments | None, space: str, *, weighting: LightWeights,
                 device: str, model: ModelUse) -> None:
        """Keep what the frames of the capture have in common.
        `space`: the scene-linear space of the stack. `device`: where maps are shared out."""
        self._lights, self._stack, self._environments, self._space = lights, stack, environments, space
        self._weighting, self._device, self._model = weighting, device, model
        self._range = RangeLighting(lights.direction, weighting) if model is ModelUse.RANGE else None

    @property
    def beyond_degrees(self) -> float:
        """Return the least angle from every captured light, in degrees, of light that counts in `FrameLight.share_beyond`."""
        return float(np.degrees(2 * reach(self._lights.direction)))

    def frames(self, scheduled: Sequence[ScheduledFrame]) -> Iterator[FrameLight]:
        """Yield the light of each frame; a map is read when its first frame comes."""
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
            if self._range is not None:
                spread, share = self._range.light(light, self._captured_energy(each, captured))
                yield FrameLight(each, None, spread, share)
                continue
            samples = far_samples(light)
            beyond = share_beyond(self._lights.direction, samples.direction)
            model = None
            if self._model is ModelUse.FRAME:
                model = model_light(samples, beyond, self._captured_energy(each, captured), self._lights.direction, self._weighting)
            yield FrameLight(each, model, None,
                             float(samples.energy[beyond >= 1].sum() / max(samples.energy.sum(), np.finfo(float).tiny)))

    def _weights(self, run: Sequence[FarLight]) -> np.ndarray:
        """Return [frames, 3, lights padded] float32 weights that stand for environment and discs."""
        if run[0].environment is None and not any(light.discs for light in run):
            return np.zeros((len(run), 3, len(self._stack.scale)), dtype=np.float32)
        energy = shared_energy(run, self._lights.direction, weighting=self._weighting, device=self._device)
        return light_weights(energy, self._lights.irradiance, self._stack.scale)

    def _captured_energy(self, weights: np.ndarray, captured: Mapping[int, float]) -> CapturedEnergy:
        """Return what a frame takes of the captured images, by the weights [3, lights padded] of the stored images, among which `captured`
        says how much of which the frame adds."""
        irradiance = self._lights.irradiance
        count = len(irradiance)
        scale = np.asarray(self._stack.scale[:count], dtype=np.float64)
        # from the float32 weights and not from the energy, so that the model subtracts exactly what the sum of images added
        shares = np.divide(weights[:, :count].T, scale[:, None], out=np.zeros((count, 3)), where=scale[:, None] > 0)
        added = np.zeros((count, 3))
        for index, weight in captured.items():
            shares[index] -= weight
            added[index] += weight * irradiance[index]
        return CapturedEnergy(shares * irradiance, added if captured else None)


def shared_energy(run: Sequence[FarLight], directions: np.ndarray, *, weighting: LightWeights, device: str) -> np.ndarray:
    """Share the environment and the discs of frames out over lights.

    Args:
        run: the light of each frame, all under one environment map or under none.
        directions: [lights, 3] unit vectors to the lights.
        weighting: how.
        device: where the map is shared out.

    Returns:
        [frames, lights, 3] float64 energy of each light.
    """
    energy = np.zeros((len(run), len(directions), 3))
    environment = run[0].environment
    if environment is not None:
        given = integrate(environment.radiance, directions, np.stack([light.rotation for light in run]), weighting=weighting, device=device)
        energy += given * np.array([light.gain for light in run])[:, None, None]
    discs = [(index, disc) for index, light in enumerate(run) for disc in light.discs]
    if discs:
        shares = integrate_discs(np.stack([disc.direction for _, disc in discs]), np.array([disc.angle_degrees for _, disc in discs]),
                                 directions, weighting=weighting)
        for (index, disc), share in zip(discs, shares, strict=True):
            energy[index] += share[:, None] * disc.irradiance
    return energy
