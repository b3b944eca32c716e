"""What lights a frame → what each stored image is multiplied by."""

from collections.abc import Iterator, Sequence
from itertools import groupby

import numpy as np

from kernels.relight.discs import integrate_discs
from kernels.relight.environment import Weighting, integrate, light_weights
from kernels.relight.latlong import LightEnergy
from service.light.environments import Environments
from service.light.schedule import FrameLighting
from stage.colour import rgb_matrix
from stage.point_lights import DistantLights
from stage.stack import Stack

RUN = 256
"""Frames under one map whose weights are found together: turns of the map that differ by whole samples share most of the work."""


def frame_weights(lighting: Sequence[FrameLighting], environments: Environments | None, lights: DistantLights, stack: Stack,
                  space: str, *, weighting: Weighting, device: str) -> Iterator[np.ndarray]:
    """Weights of each frame, without its exposure; a map is read when its first frame comes.

    Args:
        lighting: of each frame.
        environments: that their maps are read from.
        lights: of the stack.
        space: the stack's scene-linear space.
        weighting: how light from between the lights is shared out over them.
        device: where maps are shared out.

    Returns:
        [3, lights padded] float32 a frame.

    Raises:
        StageError, KernelError: a map cannot be used; names it.
    """
    for _, group in groupby(lighting, key=lambda frame: None if frame.sky is None else frame.sky.path):
        frames = list(group)
        for begin in range(0, len(frames), RUN):
            yield from _run_weights(frames[begin : begin + RUN], environments, lights, stack, space, weighting, device)


def _run_weights(frames: Sequence[FrameLighting], environments: Environments | None, lights: DistantLights, stack: Stack,
                 space: str, weighting: Weighting, device: str) -> np.ndarray:
    """[frames, 3, lights padded] of frames under one map, or under none."""
    energy = np.zeros((len(frames), len(lights.direction), 3))
    skies = [frame.sky for frame in frames if frame.sky is not None]
    discs = [(index, disc) for index, frame in enumerate(frames) for disc in frame.discs]
    if skies and environments is not None:
        given = integrate(environments.read(skies[0].path, space), lights.direction, np.stack([sky.rotation for sky in skies]),
                          weighting=weighting, device=device)
        energy += given.energy * np.array([2.0**sky.stops for sky in skies])[:, None, None]
    if discs:
        shares = integrate_discs(np.stack([disc.direction for _, disc in discs]), np.array([disc.angle_degrees for _, disc in discs]),
                                 lights.direction, weighting=weighting)
        for (index, disc), share in zip(discs, shares, strict=True):
            irradiance = np.maximum(rgb_matrix(disc.color_space, space) @ disc.irradiance, 0)  # as of a map's colours
            energy[index] += share[:, None] * irradiance
    if skies or discs:
        weights = light_weights(LightEnergy(energy, np.zeros(energy.shape[:2])), lights.irradiance, stack.scale)
    else:
        weights = np.zeros((len(frames), 3, len(stack.scale)), dtype=np.float32)
    for index, frame in enumerate(frames):
        for image, weight in frame.captured.items():
            light = stack.frames.index(image)
            weights[index, :, light] += weight * stack.scale[light]
    return weights
