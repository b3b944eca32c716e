"""Least squares on every light that gave a reading (Woodham 1980)."""

from functools import cache
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.errors import ArrayError
from kernels.packs import Band, as_packs, pack_type, scalars
from kernels.photometric.least_squares import confidence_of, fit_pixel, symmetric
from kernels.photometric.near import Near, toward_or_none
from kernels.photometric.readings import Readings
from kernels.status import OK


class NormalFit(NamedTuple):
    """Normals of a band; the last axis is pixels, padded to whole packs. Only pixels with status OK have values."""

    normal: wp.array  # [3, pixels] float32, unit
    confidence: wp.array  # [pixels] float32, 0…1: 1 / (1 + standard error of the normal / 1°)
    residual: wp.array  # [pixels] float32, RMS of (reading - b·l) / |b| over the lit lights
    status: wp.array  # [pixels] int32, kernels.status.Status


def solve_lambert(band: Band, readings: Readings, directions: np.ndarray, near: Near | None = None) -> NormalFit:
    """Least squares on every light with a reading above zero.

    Args:
        band: the stack on the device.
        readings: its grey readings; on return each holds the weight that the light had in the fit: 1 or 0.
        directions: [lights, 3] unit, from the surface to the light; padding is ignored.
        near: directions and falloff per pixel, in place of `directions`, where some light is near.

    Returns:
        Normals on the device; not synchronised on CUDA.

    Raises:
        ArrayError: directions do not match the band.

    Source:
        Woodham, "Photometric method for determining surface orientation from multiple images", Optical Engineering 1980.
    """
    return run_normal_kernel(_lambert_kernel, band, readings, directions, near)


def run_normal_kernel(make: Any, band: Band, readings: Readings, directions: np.ndarray, near: Near | None) -> NormalFit:
    """Launch a kernel that turns readings into normals; shared by the solvers that differ in the kernel alone."""
    if directions.shape != (band.light_count, 3):
        raise ArrayError(f"directions are {directions.shape}, the band has {band.light_count} lights: give a row for each")
    fit = NormalFit(scalars(band.pixel_count, 3, wp.float32, band.device),
                    scalars(band.pixel_count, None, wp.float32, band.device),
                    scalars(band.pixel_count, None, wp.float32, band.device),
                    scalars(band.pixel_count, None, wp.int32, band.device))
    lights = wp.array(np.ascontiguousarray(directions, dtype=np.float32), dtype=wp.vec3, device=band.device)
    devices.launch(make(devices.pack_width(band.device), near is not None), band.packs,
                   [lights, toward_or_none(near, band.device), readings.pack_stride, readings.light_stride],
                   [readings.values, *(as_packs(array, band.device) for array in fit)], device=band.device)
    return fit


@cache
def _lambert_kernel(pack: int, near: bool = False) -> Any:
    float_pack, int_pack = pack_type(pack, wp.float32), pack_type(pack, wp.int32)

    @wp.kernel(enable_backward=False, module="unique")
    def lambert_kernel(first: int,
                       lights: wp.array(dtype=wp.vec3),  # [L]
                       toward: wp.array2d(dtype=float_pack),  # [3, P · L] in place of lights, if near
                       pack_stride: int,
                       light_stride: int,
                       # outputs
                       readings: wp.array(dtype=float_pack),  # in: readings, out: weights
                       normal: wp.array2d(dtype=float_pack),  # [3, P]
                       confidence: wp.array(dtype=float_pack),  # [P]
                       residual: wp.array(dtype=float_pack),  # [P]
                       status: wp.array(dtype=int_pack)):  # [P]
        p = first + wp.tid()
        xx, xy, xz, yy, yz, zz = float_pack(), float_pack(), float_pack(), float_pack(), float_pack(), float_pack()
        rx, ry, rz, squares, count = float_pack(), float_pack(), float_pack(), float_pack(), float_pack()
        for light in range(lights.shape[0]):
            at = p * pack_stride + light * light_stride
            y = readings[at]
            weight = float_pack()
            if wp.static(near):
                tx = toward[0, at]
                ty = toward[1, at]
                tz = toward[2, at]
            else:
                lx, ly, lz = lights[light][0], lights[light][1], lights[light][2]
            for k in range(pack):
                if wp.static(near):
                    lx, ly, lz = tx[k], ty[k], tz[k]
                w = wp.where(y[k] > 0.0, 1.0, 0.0)
                weight[k] = w
                count[k] += w
                squares[k] += y[k] * y[k]
                rx[k] += y[k] * lx
                ry[k] += y[k] * ly
                rz[k] += y[k] * lz
                xx[k] += w * lx * lx
                xy[k] += w * lx * ly
                xz[k] += w * lx * lz
                yy[k] += w * ly * ly
                yz[k] += w * ly * lz
                zz[k] += w * lz * lz
            readings[at] = weight
        nx, ny, nz, code = float_pack(), float_pack(), float_pack(), int_pack()
        sure, off = float_pack(), float_pack()
        for k in range(pack):
            fit = fit_pixel(symmetric(xx[k], xy[k], xz[k], yy[k], yz[k], zz[k]), wp.vec3(rx[k], ry[k], rz[k]),
                            squares[k], int(count[k]))
            if fit.status == OK:
                n = wp.normalize(fit.b)
                nx[k] = n[0]
                ny[k] = n[1]
                nz[k] = n[2]
                sure[k] = confidence_of(fit.across, fit.residual, count[k])
                off[k] = wp.sqrt(fit.residual / count[k])
            code[k] = fit.status
        normal[0, p] = nx
        normal[1, p] = ny
        normal[2, p] = nz
        confidence[p] = sure
        residual[p] = off
        status[p] = code

    return lambert_kernel
