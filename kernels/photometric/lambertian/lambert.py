"""Least squares on every light that gave a reading (Woodham 1980)."""

from typing import Any, NamedTuple

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.device import once
from kernels.errors import ArrayError
from kernels.normal_equations import add_reading, fit_pixel, symmetric
from kernels.packs import Band, pack_type, zeros
from kernels.photometric.lambertian.near import NearLights, directions_in, toward_or_none
from kernels.photometric.lambertian.readings import Readings
from kernels.status import OK

SHADOW_FRACTION = 0.1
"""Fraction of the brightest reading below which a reading may be in shadow, and b·l need not predict it."""

PRODUCTS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
"""Entries of a symmetric matrix, in the order of the sums of add_reading."""


class NormalFit(NamedTuple):
    """Normals of a band, and what their uncertainty follows from; the last axis is pixels, padded to whole packs. Only pixels with
    status OK have values. kernels.photometric.model.misfit makes standard errors and confidence of the last five."""

    normal: wp.array  # [3, pixels] float32, unit
    residual: wp.array  # [pixels] float32, RMS of (reading - b·l) / |b| over the readings of the fit, by their weights
    status: wp.array  # [pixels] int32, kernels.status.Status
    across: wp.array  # [pixels] float32, radians²: variance of the normal for independent errors of variance |b|² in the readings
    squares: wp.array  # [pixels] float32, sum of the squared errors of the readings that the residuals show, in |b|²
    freedom: wp.array  # [pixels] float32, degrees of freedom of `squares`: the weights of the readings, less the three unknowns
    spare: wp.array  # [pixels] float32, number of readings beyond three that are lit, or that b·l says should be, and could be rejected
    agreeing: wp.array  # [pixels] float32, how many of them b·l predicts; a solver that rejects none has 0 of both


def solve_lambert(band: Band, readings: Readings, directions: np.ndarray, near_lights: NearLights | None = None) -> NormalFit:
    """Estimate normals by least squares on every light with a reading above zero; not synchronised on CUDA.

    Args:
        readings: its grey readings; on return each holds the weight that the light had in the fit: 1 or 0.
        directions: [lights, 3] unit, from the surface to the light; padding is ignored.
        near_lights: directions and falloff per pixel, in place of `directions`, where some light is near.

    Source:
        Woodham, "Photometric method for determining surface orientation from multiple images", Optical Engineering 1980.
    """
    exact = directions.astype(np.float64)
    products = np.array([(exact[:, i] * exact[:, j]).sum() for i, j in PRODUCTS])
    return run_normal_kernel(_lambert_kernel, band, readings, directions, near_lights,
                             wp.array(products, dtype=wp.float32, device=band.device), int(directions.any(axis=1).sum()))


def run_normal_kernel(make: Any, band: Band, readings: Readings, directions: np.ndarray, near_lights: NearLights | None,
                      *more: Any) -> NormalFit:
    """Launch a kernel that turns readings into normals; shared by solvers that differ in the kernel alone, and in what more it takes."""
    if directions.shape != (band.frame_count, 3):
        raise ArrayError(f"directions are {directions.shape}, the band has {band.frame_count} lights: give a row for each")
    def floats() -> wp.array:
        return zeros(band.pixel_count, wp.float32, band.device)

    fit = NormalFit(zeros(band.pixel_count, wp.float32, band.device, rows=3), floats(), zeros(band.pixel_count, wp.int32, band.device),
                    floats(), floats(), floats(), floats(), floats())
    lights = wp.array(directions, dtype=wp.vec3, device=band.device)
    devices.launch(make(devices.pack_width(band.device), near_lights is not None), band.packs,
                   [lights, toward_or_none(near_lights, band.device), readings.pack_stride, readings.light_stride, *more],
                   [readings.values, _as_struct(fit)], device=band.device)
    return fit


@wp.struct
class NormalArrays:
    """The arrays of a NormalFit, as a kernel writes them."""

    normal: wp.array2d(dtype=float)  # [3, N]
    residual: wp.array(dtype=float)  # [N], as the others
    status: wp.array(dtype=int)
    across: wp.array(dtype=float)
    squares: wp.array(dtype=float)
    freedom: wp.array(dtype=float)
    spare: wp.array(dtype=float)
    agreeing: wp.array(dtype=float)


def _as_struct(fit: NormalFit) -> Any:
    arrays = NormalArrays()
    for name, array in fit._asdict().items():
        setattr(arrays, name, array)
    return arrays


@wp.func
def write_normal(pixel: int, b: wp.vec3, code: int, residual: float, across: float, squares: float, freedom: float,
                 spare: float, agreeing: float,
                 # outputs
                 fit: NormalArrays):
    """Write one pixel of a NormalFit; only its status where that is not OK."""
    fit.status[pixel] = code
    if code == OK:
        n = wp.normalize(b)
        fit.normal[0, pixel] = n[0]
        fit.normal[1, pixel] = n[1]
        fit.normal[2, pixel] = n[2]
        fit.residual[pixel] = residual
        fit.across[pixel] = across
        fit.squares[pixel] = squares
        fit.freedom[pixel] = freedom
        fit.spare[pixel] = spare
        fit.agreeing[pixel] = agreeing


@once
def _lambert_kernel(pack: int, near: bool = False) -> Any:
    float_pack = pack_type(pack, wp.float32)
    directions_of, step = directions_in(pack, near)

    @wp.kernel(enable_backward=False, module="unique")
    def lambert_kernel(first: int,
                       lights: wp.array(dtype=wp.vec3),  # [L]
                       toward: wp.array2d(dtype=float_pack),  # [3, P · L] in place of lights, if near
                       pack_stride: int,
                       light_stride: int,
                       products: wp.array(dtype=float),  # [6] Σ l lᵀ over all lights
                       light_count: int,  # without padding
                       # outputs
                       readings: wp.array(dtype=float_pack),  # in: readings, out: weights
                       fit: NormalArrays):
        p = first + wp.tid()
        xx, xy, xz, yy, yz, zz = float_pack(), float_pack(), float_pack(), float_pack(), float_pack(), float_pack()
        rx, ry, rz, squares, count = float_pack(), float_pack(), float_pack(), float_pack(), float_pack()
        top, bright = float_pack(), float_pack()
        for light in range(lights.shape[0]):
            y = readings[p * pack_stride + light * light_stride]
            for k in range(pack):
                top[k] = wp.max(top[k], y[k])
                count[k] += wp.where(y[k] > 0.0, 1.0, 0.0)
        fewest = float(lights.shape[0])
        for k in range(pack):
            fewest = wp.min(fewest, count[k])
        if not near and fewest >= float(light_count):  # each pixel has every reading, and Σ l lᵀ is the same for all
            for k in range(pack):
                xx[k] = products[0]
                xy[k] = products[1]
                xz[k] = products[2]
                yy[k] = products[3]
                yz[k] = products[4]
                zz[k] = products[5]
            for light in range(lights.shape[0]):
                at = p * pack_stride + light * light_stride
                y = readings[at]
                direction = lights[light]
                weight = float_pack()
                for k in range(pack):
                    weight[k] = wp.where(y[k] > 0.0, 1.0, 0.0)
                    bright[k] += wp.where(y[k] > SHADOW_FRACTION * top[k], 1.0, 0.0)
                    rx[k] += y[k] * direction[0]
                    ry[k] += y[k] * direction[1]
                    rz[k] += y[k] * direction[2]
                    squares[k] += y[k] * y[k]
                readings[at] = weight
        else:
            for light in range(lights.shape[0]):
                at = p * pack_stride + light * light_stride
                y = readings[at]
                lx, ly, lz = directions_of(lights, toward, light, at)
                weight = float_pack()
                for k in range(pack):
                    weight[k] = wp.where(y[k] > 0.0, 1.0, 0.0)
                    bright[k] += wp.where(y[k] > SHADOW_FRACTION * top[k], 1.0, 0.0)
                    add_reading(y[k], weight[k], lx[step * k], ly[step * k], lz[step * k], xx[k], xy[k], xz[k], yy[k], yz[k], zz[k],
                                rx[k], ry[k], rz[k], squares[k])
                readings[at] = weight
        for k in range(pack):
            found = fit_pixel(symmetric(xx[k], xy[k], xz[k], yy[k], yz[k], zz[k]), wp.vec3(rx[k], ry[k], rz[k]),
                              squares[k], int(count[k]))
            # three bright readings and dark ones, which may be shadow, leave nothing to check the fit with
            write_normal(p * pack + k, found.b, found.status, wp.sqrt(found.residual / wp.max(count[k], 1.0)), found.across,
                         found.residual, wp.where(bright[k] > 3.0, count[k] - 3.0, 0.0), 0.0, 0.0, fit)

    return lambert_kernel
