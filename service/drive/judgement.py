"""The light that a subject receives from driven lamps, against the light of the environment: irradiance of a sphere of normals."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from kernels.relight.model.sources import disc_samples
from service.relight.environments import EnvironmentMap
from service.relight.far_light import FarLight, disc_light
from stage.colour.colour import rgb_matrix
from stage.rig.rig import Rig
from stage.transforms import fibonacci_sphere

NORMALS = 256
"""The number of normals."""
FOLDED_ROWS = 256
"""Larger environment maps are judged with so many rows at most: pixels are joined, energy and direction kept."""
BATCH = 256
"""The number of normals that are lit at one time: it bounds the memory."""
XYZ = "lin_ciexyzd65_scene"
DARK = 1e-3
"""The chromaticity of normals that receive, or should, less than this part of the mean irradiance is not judged: no light has no colour."""


class Judgement(NamedTuple):
    """The error of the light of frames."""

    rms: np.ndarray  # [frames] root mean square error of the irradiance over the normals and channels, over that of the environment
    chromaticity: np.ndarray  # [frames] largest Δu'v' of a normal, CIE 1976
    energy: np.ndarray  # [frames] irradiance of all lamps, over the energy of the environment


def judge(
    run: Sequence[FarLight],  # the light of each frame, all under one environment map or under none
    level: np.ndarray,  # [frames, emitters] of `rig.emitters`, 0…1
    rig: Rig,
    exposure: np.ndarray,  # [frames] factor on the environment and the discs
) -> Judgement:
    """Compare lamps with the environment, on normals that turn with it."""
    lamps, towards = lamp_irradiance(level, rig), rig.directions
    normals = fibonacci_sphere(NORMALS)
    environment = run[0].environment
    direction, energy = (np.zeros((1, 3)), np.zeros((1, 3))) if environment is None else environment_samples(environment)
    still = irradiance_of(direction, energy, normals)
    to_xyz = rgb_matrix(rig.color_space, XYZ).astype(np.float64)
    found = []
    for light, lamp, factor in zip(run, lamps, exposure, strict=True):
        turned = normals @ light.rotation.T
        wanted, whole = still * light.gain, energy.sum() * light.gain
        for disc in light.discs:
            samples = disc_light(disc, disc_samples(disc.direction, disc.angle_degrees))
            wanted = wanted + irradiance_of(samples.direction, samples.energy, turned)
            whole += samples.energy.sum()
        wanted = wanted * factor
        given = irradiance_of(towards, lamp, turned)
        lit = np.all([each.sum(axis=1) > DARK * max(each.sum(axis=1).mean(), np.finfo(float).tiny) for each in (wanted, given)], axis=0)
        off = np.linalg.norm(_uv(given[lit] @ to_xyz.T) - _uv(wanted[lit] @ to_xyz.T), axis=1)
        scale = max(float(np.sqrt((wanted**2).mean())), np.finfo(float).tiny)
        found.append((np.sqrt(((given - wanted) ** 2).mean()) / scale, off.max(initial=0),
                      lamp.sum() / max(whole * factor, np.finfo(float).tiny)))
    return Judgement(*(np.array(values) for values in zip(*found, strict=True)))


def lamp_irradiance(level: np.ndarray, rig: Rig) -> np.ndarray:
    """Return the irradiance [frames, lights, 3] that each lamp gives at levels [frames, emitters] of `rig.emitters`."""
    irradiance = np.array([primary.irradiance for _, primary in rig.emitters])
    first = np.cumsum([0, *(len(lamp.primaries) for lamp in rig.lights[:-1])])
    return np.add.reduceat(level[..., None] * irradiance, first, axis=1)


def irradiance_of(direction: np.ndarray, energy: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Return the irradiance [normals, 3] of surfaces of these normals [normals, 3] under samples of light: Σ energy max(0, n·ω)."""
    found = np.empty((len(normals), 3))
    for begin in range(0, len(normals), BATCH):
        found[begin : begin + BATCH] = np.maximum(normals[begin : begin + BATCH] @ direction.T, 0) @ energy
    return found


def far_irradiance(light: FarLight, normals: np.ndarray, most_rows: int = FOLDED_ROWS) -> np.ndarray:
    """Return the irradiance [normals, 3] of surfaces of these normals [normals, 3] under the light of a frame, before its exposure."""
    found = np.zeros((len(normals), 3))
    if light.environment is not None:
        found += irradiance_of(*environment_samples(light.environment, most_rows), normals @ light.rotation) * light.gain
    for disc in light.discs:
        samples = disc_light(disc, disc_samples(disc.direction, disc.angle_degrees))
        found += irradiance_of(samples.direction, samples.energy, normals)
    return found


def environment_samples(environment: EnvironmentMap, most_rows: int = FOLDED_ROWS) -> tuple[np.ndarray, np.ndarray]:
    """Return samples of a map, unit vectors [n, 3] and their energies [n, 3], as many as a map of `most_rows` rows has or fewer.

    They are found once for each map, and are not to be changed.
    """
    if most_rows not in environment.folded:
        environment.folded[most_rows] = _folded(environment.radiance, most_rows)
    return environment.folded[most_rows]


def _folded(radiance: np.ndarray, most_rows: int) -> tuple[np.ndarray, np.ndarray]:
    rows, columns = radiance.shape[:2]
    side = -(-rows // most_rows)
    directions, energies = [], []
    for first in range(0, rows, side):
        down = np.pi * (np.arange(first, min(first + side, rows)) + 0.5) / rows
        solid = np.sin(down)[:, None] * (np.pi / rows) * (2 * np.pi / columns)
        energy = radiance[first : first + side].astype(np.float64) * solid[..., None]
        direction = texel_directions(down, columns)
        weight = np.maximum(energy.sum(axis=2), 1e-100)
        starts = np.arange(0, columns, side)
        folded = np.add.reduceat((direction * weight[..., None]).sum(axis=0), starts, axis=0)
        directions.append(folded / np.linalg.norm(folded, axis=1, keepdims=True))
        energies.append(np.add.reduceat(energy.sum(axis=0), starts, axis=0))
    return np.concatenate(directions), np.concatenate(energies)


def texel_directions(down: np.ndarray, columns: int) -> np.ndarray:
    """Return the unit vectors [rows, columns, 3] to the texels of a lat-long map in rows at these angles from +y, radians."""
    across, sine = 2 * np.pi * (np.arange(columns) + 0.5) / columns, np.sin(down)[:, None]
    return np.stack(np.broadcast_arrays(np.sin(across) * sine, np.cos(down)[:, None], -np.cos(across) * sine), axis=-1)


def _uv(xyz: np.ndarray) -> np.ndarray:
    """Return CIE 1976 u'v' [n, 2] of XYZ [n, 3]."""
    x, y, z = xyz.T
    whole = np.maximum(x + 15 * y + 3 * z, np.finfo(float).tiny)
    return np.stack([4 * x / whole, 9 * y / whole], axis=1)
