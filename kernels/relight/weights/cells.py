"""Cell weighting: a lat-long map is integrated over each light's cell of the sphere.

The cell of a light is the part of the sphere nearer to it than to any other light (spherical Voronoi). A sample within a cell goes
whole to its light; one that a border crosses is divided along it, by area. So a cell has the solid angle of its polygon, no energy is
lost, however small a sun, and a sun that moves over a border changes lights over its own width and not at once.

Source: Debevec et al., SIGGRAPH 2000, section 3.3.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.device import once, to_numpy
from kernels.packs import pack_type
from kernels.relight.directions.latlong import SampleGrid, check, first_of_equals
from kernels.relight.weights.borders import LatLongSamples, Shares, divide, reach
from kernels.relight.weights.turned_sums import LightEnergy, gather

COSINE_STEP = 1e-6
"""Largest error of a cosine, or of the difference of two cosines, in float32."""


class Nearest(NamedTuple):
    """The nearest light at each sample of a grid."""

    light: np.ndarray  # [rows, cols] int32; of equally near lights the first
    crossed: np.ndarray  # [rows, cols] bool: a border may cross the sample; where False, none does


def integrate_cells(environment: np.ndarray, directions: np.ndarray, rotations: np.ndarray, *, device: str) -> LightEnergy:
    """Integrate a lat-long map over the cells of the lights, for several rotations of the map.

    Both energy and solid angle of the cells sum to those of the whole map. Of lights in one place the first has the cell.

    Args:
        environment: [rows, cols, 3] scene-linear radiance; top row +y, image centre +z, a quarter from the left +x.
        directions: [lights, 3] unit vectors from the object to the lights (without padding).
        rotations: [frames, 3, 3]: the environment is turned by these, turned = rotation @ direction.
        device: where the nearest lights are found; sums are taken on the host in float64.
    """
    directions, rotations = check(environment, directions, rotations)
    kept = first_of_equals(directions)

    def split(rotation: np.ndarray, band: SampleGrid) -> Iterator[Shares]:
        lights = directions[kept] @ rotation
        nearest = nearest_light(band, lights, device=device)
        yield Shares(slice(None), kept[nearest.light.reshape(-1)], (~nearest.crossed).reshape(-1))
        row, col = np.nonzero(nearest.crossed)
        crossed = LatLongSamples(band.polar[row], band.azimuth[col], band.half_polar, band.half_azimuth)
        shares = divide(crossed, nearest.light[row, col], lights)
        yield Shares((row * len(band.azimuth) + col)[shares.sample], kept[shares.light], shares.share)

    return gather(environment, rotations, len(directions), split)


def nearest_light(grid: SampleGrid, directions: np.ndarray, *, device: str) -> Nearest:
    """Find the nearest light at each sample of a grid, and whether a border between two cells may cross the sample; waits for the device.

    Directions are [lights, 3] unit vectors, all different.
    """
    pack = devices.pack_width(device)
    rows, cols = len(grid.polar), len(grid.azimuth)
    azimuth = np.pad(grid.azimuth, (0, -cols % pack))
    packs = len(azimuth) // pack
    float_pack = pack_type(pack, wp.float32)
    corner = reach(grid.polar, grid.half_polar, grid.half_azimuth)
    on_rows = np.stack([np.sin(grid.polar), np.cos(grid.polar), corner], axis=1).astype(np.float32)
    east = wp.array(np.sin(azimuth).astype(np.float32).reshape(-1, pack), dtype=float_pack, device=device)
    north = wp.array(-np.cos(azimuth).astype(np.float32).reshape(-1, pack), dtype=float_pack, device=device)
    lights = wp.array(directions, dtype=wp.vec3, device=device)
    marked = wp.empty((rows, packs), dtype=pack_type(pack, wp.int32), device=device)
    devices.launch(_nearest_kernel(pack), rows * packs, [wp.array(on_rows, dtype=wp.vec3, device=device), east, north, lights],
                   [marked], device=device)
    found = to_numpy(marked).reshape(rows, -1)[:, :cols]
    crossed = found < 0
    return Nearest(np.where(crossed, ~found, found), crossed)


@once
def _nearest_kernel(pack: int) -> Any:
    float_pack, int_pack = pack_type(pack, wp.float32), pack_type(pack, wp.int32)

    @wp.kernel(enable_backward=False, module="unique")
    def nearest_kernel(first: int,
                       row_angles: wp.array(dtype=wp.vec3),  # [rows] sine and cosine of the angle from +y; a sample's reach
                       east: wp.array(dtype=float_pack),  # [P] x of a direction on the equator
                       north: wp.array(dtype=float_pack),  # [P] z of it
                       lights: wp.array(dtype=wp.vec3),  # [L]
                       # outputs
                       nearest: wp.array2d(dtype=int_pack)):  # [rows, P] index of the light, or its ~ where a border may cross
        thread = first + wp.tid()
        row = thread / east.shape[0]
        p = thread % east.shape[0]
        sine, cosine, reach = row_angles[row][0], row_angles[row][1], row_angles[row][2]
        x, z = sine * east[p], sine * north[p]
        best, second, index = float_pack(-2.0), float_pack(-3.0), float_pack()
        for light in range(lights.shape[0]):
            flat = x * lights[light][0] + z * lights[light][2]
            up = cosine * lights[light][1]
            number = float(light)  # exact: there are fewer than 2²⁴
            for k in range(pack):
                near = flat[k] + up
                # by arithmetic: a choice by wp.where keeps the compiler from SIMD, and the kernel takes thirty times as long
                index[k] += wp.step(best[k] - near) * (number - index[k])
                second[k] = wp.max(second[k], wp.min(near, best[k]))
                best[k] = wp.max(best[k], near)
        marked = int_pack()
        for k in range(pack):
            # a border within reach is with a light at most twice as far from this one as the sample is, and the reach on both sides
            apart = 2.0 * (wp.sqrt(wp.max(2.0 - 2.0 * best[k], 0.0)) + reach)
            light = int(index[k])
            marked[k] = wp.where(best[k] - second[k] > reach * apart + COSINE_STEP, light, -1 - light)
        nearest[row, p] = marked

    return nearest_kernel
