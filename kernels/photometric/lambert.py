"""Least squares on every light that gave a reading (Woodham 1980)."""

from functools import cache
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.errors import ArrayError
from kernels.normal_equations import add_reading, symmetric
from kernels.packs import Band, pack_type, zeros
from kernels.photometric.least_squares import confidence_of, fit_pixel
from kernels.photometric.near import NearLights, directions_in, toward_or_none
from kernels.photometric.readings import Readings
from kernels.status import OK


class NormalFit(NamedTuple):
    """Normals of a band; the last axis is pixels, padded to whole packs. Only pixels with status OK have values."""

    normal: wp.array  # [3, pixels] float32, unit
    confidence: wp.array  # [pixels] float32, 0…1: 1 / (1 + standard error of the normal / 1°)
    residual: wp.array  # [pixels] float32, RMS of (reading - b·l) / |b| over the lit lights
    status: wp.array  # [pixels] int32, kernels.status.Status


def solve_lambert(band: Band, readings: Readings, directions: np.ndarray, near_lights: NearLights | None = None) -> NormalFit:
    """Estimate normals by least squares on every light with a reading above zero.

    Args:
        band: the stack on the device.
        readings: its grey readings; on return each holds the weight that the light had in the fit: 1 or 0.
        directions: [lights, 3] unit, from the surface to the light; padding is ignored.
        near_lights: directions and falloff per pixel, in place of `directions`, where some light is near.

    Returns:
        Normals on the device; not synchronised on CUDA.

    Raises:
        ArrayError: directions do not match the band.

    Source:
        Woodham, "Photometric method for determining surface orientation from multiple images", Optical Engineering 1980.
    """
    return run_normal_kernel(_lambert_kernel, band, readings, directions, near_lights)


def run_normal_kernel(make: Any, band: Band, readings: Readings, directions: np.ndarray, near_lights: NearLights | None) -> NormalFit:
    """Launch a kernel that turns readings into normals; shared by the solvers that differ in the kernel alone."""
    if directions.shape != (band.frame_count, 3):
        raise ArrayError(f"directions are {directions.shape}, the band has {band.frame_count} lights: give a row for each")
    fit = NormalFit(zeros(band.pixel_count, wp.float32, band.device, rows=3),
                    zeros(band.pixel_count, wp.float32, band.device),
                    zeros(band.pixel_count, wp.float32, band.device),
                    zeros(band.pixel_count, wp.int32, band.device))
    lights = wp.array(directions, dtype=wp.vec3, device=band.device)
    devices.launch(make(devices.pack_width(band.device), near_lights is not None), band.packs,
                   [lights, toward_or_none(near_lights, band.device), readings.pack_stride, readings.light_stride],
                   [readings.values, *fit], device=band.device)
    return fit


@wp.func
def write_normal(b: wp.vec3, across: float, residual: float, count: float, code: int, pixel: int,
                 normal: wp.array2d(dtype=float), confidence: wp.array(dtype=float), off: wp.array(dtype=float),
                 status: wp.array(dtype=int)):
    """Write one pixel of a NormalFit: b and `across` of its LambertFit, `residual` the sum Σ (y - b·l)² / |b|² over `count` readings."""
    status[pixel] = code
    if code == OK:
        n = wp.normalize(b)
        normal[0, pixel] = n[0]
        normal[1, pixel] = n[1]
        normal[2, pixel] = n[2]
        confidence[pixel] = confidence_of(across, residual, count)
        off[pixel] = wp.sqrt(residual / count)


@cache
def _lambert_kernel(pack: int, near: bool = False) -> Any:
    float_pack = pack_type(pack, wp.float32)
    directions_of, step = directions_in(pack, near)

    @wp.kernel(enable_backward=False, module="unique")
    def lambert_kernel(first: int,
                       lights: wp.array(dtype=wp.vec3),  # [L]
                       toward: wp.array2d(dtype=float_pack),  # [3, P · L] in place of lights, if near
                       pack_stride: int,
                       light_stride: int,
                       # outputs
                       readings: wp.array(dtype=float_pack),  # in: readings, out: weights
                       normal: wp.array2d(dtype=float),  # [3, N]
                       confidence: wp.array(dtype=float),  # [N]
                       residual: wp.array(dtype=float),  # [N]
                       status: wp.array(dtype=int)):  # [N]
        p = first + wp.tid()
        xx, xy, xz, yy, yz, zz = float_pack(), float_pack(), float_pack(), float_pack(), float_pack(), float_pack()
        rx, ry, rz, squares, count = float_pack(), float_pack(), float_pack(), float_pack(), float_pack()
        for light in range(lights.shape[0]):
            at = p * pack_stride + light * light_stride
            y = readings[at]
            lx, ly, lz = directions_of(lights, toward, light, at)
            weight = float_pack()
            for k in range(pack):
                weight[k] = wp.where(y[k] > 0.0, 1.0, 0.0)
                count[k] += weight[k]
                add_reading(y[k], weight[k], lx[step * k], ly[step * k], lz[step * k], xx[k], xy[k], xz[k], yy[k], yz[k], zz[k],
                            rx[k], ry[k], rz[k], squares[k])
            readings[at] = weight
        for k in range(pack):
            fit = fit_pixel(symmetric(xx[k], xy[k], xz[k], yy[k], yz[k], zz[k]), wp.vec3(rx[k], ry[k], rz[k]),
                            squares[k], int(count[k]))
            write_normal(fit.b, fit.across, fit.residual, count[k], fit.status, p * pack + k, normal, confidence, residual, status)

    return lambert_kernel
