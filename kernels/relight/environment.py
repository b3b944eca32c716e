"""A lat-long environment → per-light RGB weights: the map is integrated over each light's cell of the sphere.

The cell of a light is the part of the sphere nearer to it than to any other light (spherical Voronoi). Every texel, cut into
samples half a degree apart, goes whole to its nearest light: no energy is lost, however small a sun, and nothing is resampled
when the environment turns, because the lights are turned the other way instead.

Source: Debevec et al., SIGGRAPH 2000, section 3.3; the weight of a light of irradiance E is ∫ L dω over its cell, divided by E.
"""

import math
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.errors import ArrayError
from kernels.packs import pack_type

SAMPLE_PITCH_DEGREES = 0.5
"""Coarser maps are cut finer than their texels, so that a texel on a cell border is shared fairly."""
UNIT_TOLERANCE = 1e-3
"""How far a light direction's length may be from one: the nearest light is found by the cosine alone."""


class CellEnergy(NamedTuple):
    """What an environment sends through each light's cell."""

    energy: np.ndarray  # [frames, lights, 3] float64: ∫ L dω, W/m² of the map's unit
    solid_angle: np.ndarray  # [frames, lights] float64 steradians of each cell


def integrate_cells(environment: np.ndarray, directions: np.ndarray, rotations: np.ndarray, *, device: str) -> CellEnergy:
    """Integrate a lat-long map over the cells of the lights, for several rotations of the map.

    Args:
        environment: [rows, cols, 3] scene-linear radiance; top row +y, image centre +z, a quarter from the left +x.
        directions: [lights, 3] unit vectors from the object to the lights (without padding).
        rotations: [frames, 3, 3]: the environment is turned by these, turned = rotation @ direction.
        device: where the nearest lights are found; sums are taken on the host in float64.

    Returns:
        Energy and solid angle of each cell; both sum to those of the whole map.

    Raises:
        ArrayError: shapes that do not fit, directions that are not unit vectors, or radiance that is negative or not finite
            (counted).
    """
    directions, rotations = np.asarray(directions, dtype=np.float64), np.asarray(rotations, dtype=np.float64)
    if directions.ndim != 2 or directions.shape[1] != 3 or len(directions) == 0:
        raise ArrayError(f"directions are {directions.shape}: give [lights, 3], one light or more")
    if rotations.ndim != 3 or rotations.shape[1:] != (3, 3):
        raise ArrayError(f"rotations are {rotations.shape}: give [frames, 3, 3]")
    length = np.linalg.norm(directions, axis=1)
    if not (np.abs(length - 1) < UNIT_TOLERANCE).all():
        raise ArrayError(f"direction of light {int(np.argmax(np.abs(length - 1)))} is not a unit vector")
    if environment.ndim != 3 or environment.shape[2] != 3 or min(environment.shape[:2]) < 1:
        raise ArrayError(f"environment is {environment.shape}: give [rows, cols, 3]")
    for name, bad in (("not finite", ~np.isfinite(environment)), ("negative", environment < 0)):
        if bad.any():
            raise ArrayError(f"environment has {int(bad.any(axis=2).sum())} texels that are {name}")
    rows, cols, _ = environment.shape
    across = max(1, math.ceil(360.0 / SAMPLE_PITCH_DEGREES / cols))
    down = max(1, math.ceil(180.0 / SAMPLE_PITCH_DEGREES / rows))
    texel = np.sin(np.pi * (np.arange(rows) + 0.5) / rows) * (np.pi / rows) * (2 * np.pi / cols)
    # how a texel's solid angle falls on its rows of samples: by their sines, so that texels keep their contract total
    sines = np.sin(np.pi * (np.arange(rows * down) + 0.5) / (rows * down)).reshape(rows, down)
    share = (sines / sines.sum(axis=1, keepdims=True) / across * texel[:, None]).reshape(-1)
    lights = len(directions)
    energy = np.zeros((len(rotations), lights, 3))
    solid_angle = np.zeros((len(rotations), lights))
    for frame, rotation in enumerate(rotations):
        nearest = nearest_light(rows * down, cols * across, directions @ rotation, device=device)
        flat = nearest.reshape(-1)
        weight = np.broadcast_to(share[:, None], nearest.shape)
        solid_angle[frame] = np.bincount(flat, weights=weight.reshape(-1), minlength=lights)
        for channel in range(3):
            radiance = environment[..., channel].astype(np.float64)
            samples = np.repeat(np.repeat(radiance, down, axis=0), across, axis=1) * weight
            energy[frame, :, channel] = np.bincount(flat, weights=samples.reshape(-1), minlength=lights)
    return CellEnergy(energy, solid_angle)


def light_weights(cells: CellEnergy, irradiance: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """What each stored image is multiplied by so that the sum is lit by the environment.

    Args:
        cells: of integrate_cells.
        irradiance: [lights, 3] of each captured light, without padding.
        scale: [lights padded] radiance of a stored 1.0.

    Returns:
        [frames, 3, lights padded] float32.

    Raises:
        ArrayError: a light gives nothing in a channel, so that its cell's energy there could not be placed.
    """
    dark = np.argwhere(irradiance <= 0)
    if len(dark):
        light, channel = dark[0]
        raise ArrayError(f"irradiance of light {light} is 0 in channel {'RGB'[channel]}: "
                         "its cell of the environment would stay dark in it")
    frames, lights, _ = cells.energy.shape
    weights = np.zeros((frames, 3, len(scale)), dtype=np.float32)
    weights[:, :, :lights] = np.swapaxes(cells.energy / irradiance, 1, 2) * scale[:lights]
    return weights


def nearest_light(rows: int, cols: int, directions: np.ndarray, *, device: str) -> np.ndarray:
    """Index of the nearest light at each sample of a lat-long grid.

    Args:
        rows, cols: of the grid; the sample (r, c) is at v = (r + 0.5)/rows, u = (c + 0.5)/cols.
        directions: [lights, 3] unit vectors.

    Returns:
        [rows, cols] int32; of equally near lights the first.
    """
    pack = devices.pack_width(device)
    whole = -(-cols // pack) * pack
    azimuth = 2 * np.pi * (np.arange(whole) + 0.5) / cols
    polar = np.pi * (np.arange(rows) + 0.5) / rows
    float_pack = pack_type(pack, wp.float32)
    rows_on = wp.array(np.stack([np.sin(polar), np.cos(polar)], axis=1).astype(np.float32), dtype=wp.vec2, device=device)
    east = wp.array(np.sin(azimuth).astype(np.float32).reshape(-1, pack), dtype=float_pack, device=device)
    north = wp.array(-np.cos(azimuth).astype(np.float32).reshape(-1, pack), dtype=float_pack, device=device)
    lights = wp.array(np.ascontiguousarray(directions, dtype=np.float32), dtype=wp.vec3, device=device)
    nearest = wp.empty((rows, whole // pack), dtype=pack_type(pack, wp.int32), device=device)
    devices.launch(_nearest_kernel(pack), rows * (whole // pack), [rows_on, east, north, lights], [nearest], device=device)
    return nearest.numpy().reshape(rows, whole)[:, :cols]


@cache
def _nearest_kernel(pack: int) -> Any:
    float_pack, int_pack = pack_type(pack, wp.float32), pack_type(pack, wp.int32)

    @wp.kernel(enable_backward=False, module="unique")
    def nearest_kernel(first: int,
                       polar: wp.array(dtype=wp.vec2),  # [rows] sine and cosine of the angle from +y
                       east: wp.array(dtype=float_pack),  # [P] x of a direction on the equator
                       north: wp.array(dtype=float_pack),  # [P] z of it
                       lights: wp.array(dtype=wp.vec3),  # [L]
                       # outputs
                       nearest: wp.array2d(dtype=int_pack)):  # [rows, P]
        thread = first + wp.tid()
        row = thread / east.shape[0]
        p = thread % east.shape[0]
        sine, cosine = polar[row][0], polar[row][1]
        x, z = east[p], north[p]
        best, index = float_pack(), int_pack()
        for k in range(pack):
            best[k] = -2.0
        for light in range(lights.shape[0]):
            lx, ly, lz = lights[light][0], lights[light][1], lights[light][2]
            for k in range(pack):
                near = sine * (x[k] * lx + z[k] * lz) + cosine * ly
                closer = near > best[k]
                best[k] = wp.where(closer, near, best[k])
                index[k] = wp.where(closer, light, index[k])
        nearest[row, p] = index

    return nearest_kernel
