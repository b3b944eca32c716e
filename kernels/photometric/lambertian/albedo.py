"""Diffuse albedo per channel from solved normals and the weights that the fit gave each light (Woodham 1980), and what its uncertainty
follows from."""

from typing import Any, NamedTuple

import warp as wp

from kernels import device as devices
from kernels.device import once
from kernels.errors import ArrayError
from kernels.pack_access import pack_load
from kernels.packs import Band, as_packs, pack_type, vector_at, zeros
from kernels.photometric.lambertian.lambert import NormalFit
from kernels.photometric.lambertian.near import NearLights, directions_in, falloff_or_none, toward_or_none
from kernels.photometric.lambertian.readings import LARGEST, Lights, Readings

BEHIND = -0.05
"""Cosine between normal and light below which the surface turns away from the light, three degrees beyond its horizon."""


class AlbedoFit(NamedTuple):
    """Albedo of a band; the last axis is pixels, padded to whole packs. kernels.photometric.model.misfit makes its standard deviation of
    the others, which are relative to it."""

    albedo: wp.array  # [3, pixels] float32 ρ, scene-linear; 0 where there is no normal
    squares: wp.array  # [3, pixels] float32, sum of the squared errors that the residuals show, over that of the predicted readings
    openness: wp.array  # [pixels] float32, variance for independent errors of the readings, relative to that under a light along the normal
    tilt: wp.array  # [pixels] float32, relative change of the albedo where the normal tilts, per radian, along the steepest way
    bounced: wp.array  # [pixels] float32, mean reading under lights behind the surface, relative as `openness`; -1: there is none


def fit_albedo(band: Band, weights: Readings, fit: NormalFit, lights: Lights, near_lights: NearLights | None = None) -> AlbedoFit:
    """Fit the diffuse albedo: weighted least squares of radiance = ρ/π · E · n·l in each channel.

    Args:
        weights: what the normal solver left in its readings: the weight of each light, 0…1.
        near_lights: directions and falloff per pixel, in place of the lights' directions, where some light is near.

    Raises:
        ArrayError: a channel that no light reaches, or lights other than the band's.
    """
    band.require_channels(3)
    if len(lights.direction) != band.frame_count:
        raise ArrayError(f"there are {len(lights.direction)} padded lights, the band has {band.frame_count}: give its lights")
    dead = [name for name, lit in zip("RGB", lights.irradiance.any(axis=0), strict=True) if not lit]
    if dead:
        raise ArrayError(f"irradiance is 0 in channel {dead[0]} of every light: its albedo cannot be known")
    device = band.device
    found = AlbedoFit(*(zeros(band.pixel_count, wp.float32, device, rows=3) for _ in range(2)),
                      *(zeros(band.pixel_count, wp.float32, device) for _ in range(3)))
    devices.launch(_albedo_kernel(devices.pack_width(device), near_lights is not None), band.packs,
                   [band.values, weights.values, toward_or_none(near_lights, device), falloff_or_none(near_lights, device),
                    weights.pack_stride, weights.light_stride, as_packs(fit.normal, device),
                    wp.array(lights.direction, dtype=wp.vec3, device=device), wp.array(lights.irradiance, dtype=wp.vec3, device=device),
                    wp.array(lights.scale, dtype=wp.float32, device=device)],
                   list(found), device=device)
    return found


@wp.func
def add_channel(value: float, irradiance: float, weight: float, cosine: float, above: wp.ref[float], below: wp.ref[float],
                squares: wp.ref[float]):
    """Add one light's reading to one channel's weighted least squares, Σ w E cos · value, Σ w (E cos)² and Σ w value²."""
    w = irradiance * weight * cosine
    above += wp.where(w > 0.0, w * value, 0.0)  # a value that is not finite has weight 0, and their product is not a number
    below += w * irradiance * cosine
    squares += wp.where(w > 0.0, weight * value * value, 0.0)


@wp.func
def albedo_of(above: float, below: float) -> float:
    """Return ρ from the sums, 0 where no light counts."""
    return wp.where(below > 0.0, wp.pi * wp.max(above, 0.0) / below, 0.0)


@wp.func
def squares_of(above: float, below: float, squares: float) -> float:
    """Return the squared residuals over the squared predictions, from the sums; 0 where no light counts."""
    explained = above * above / wp.max(below, 1.0e-30)
    return wp.where(above > 0.0, wp.max(squares - explained, 0.0) / wp.max(explained, 1.0e-30), 0.0)


@once
def _albedo_kernel(pack: int, near: bool = False) -> Any:
    half_pack, float_pack, load = pack_type(pack, wp.float16), pack_type(pack, wp.float32), pack_load(pack, wp.float16)
    directions_of, step = directions_in(pack, near)

    @wp.kernel(enable_backward=False, module="unique")
    def albedo_kernel(first: int,
                      values: wp.array2d(dtype=half_pack),  # [3 · L, P] stored radiance
                      weights: wp.array(dtype=float_pack),  # [P · L]
                      toward: wp.array2d(dtype=float_pack),  # [3, P · L] in place of directions, if near
                      falloff: wp.array(dtype=float_pack),  # [P · L] irradiance here / irradiance of the light, if near
                      pack_stride: int,
                      light_stride: int,
                      normal: wp.array2d(dtype=float_pack),  # [3, P]
                      directions: wp.array(dtype=wp.vec3),  # [L]
                      irradiance: wp.array(dtype=wp.vec3),  # [L]
                      scale: wp.array(dtype=float),  # [L] radiance of a stored value of 1
                      # outputs
                      albedo: wp.array2d(dtype=float),  # [3, N]
                      squares: wp.array2d(dtype=float),  # [3, N]
                      openness: wp.array(dtype=float),  # [N]
                      tilt: wp.array(dtype=float),  # [N]
                      bounced: wp.array(dtype=float)):  # [N]
        p = first + wp.tid()
        nx, ny, nz = vector_at(normal, p)
        above_r, above_g, above_b = float_pack(), float_pack(), float_pack()
        below_r, below_g, below_b = float_pack(), float_pack(), float_pack()
        squares_r, squares_g, squares_b = float_pack(), float_pack(), float_pack()
        sx, sy, sz, shown = float_pack(), float_pack(), float_pack(), float_pack()
        behind, sent_r, sent_g, sent_b = float_pack(), float_pack(), float_pack(), float_pack()
        lights = directions.shape[0]
        for light in range(lights):
            red = load(values, light, p)
            green = load(values, lights + light, p)
            blue = load(values, 2 * lights + light, p)
            at = p * pack_stride + light * light_stride
            weight = weights[at]
            lx, ly, lz = directions_of(directions, toward, light, at)
            if wp.static(near):
                part = falloff[at]
            er, eg, eb = irradiance[light][0], irradiance[light][1], irradiance[light][2]
            unit = scale[light]  # a dark image, stored as a bright one, counts no more than others
            for k in range(pack):
                facing = nx[k] * lx[step * k] + ny[k] * ly[step * k] + nz[k] * lz[step * k]
                cosine = wp.max(facing, 0.0)
                slope = weight[k] * cosine
                shadowed = wp.where(facing < BEHIND, 1.0, 0.0)
                glow = unit * (float(red[k]) + float(green[k]) + float(blue[k]))
                behind[k] += wp.where(glow < LARGEST, shadowed * wp.max(glow, 0.0), 0.0)  # 0 also for NaN
                if wp.static(near):
                    shadowed = shadowed * part[k]
                sent_r[k] += shadowed * er
                sent_g[k] += shadowed * eg
                sent_b[k] += shadowed * eb
                if wp.static(near):
                    cosine = cosine * part[k]
                    slope = slope * part[k] * part[k]
                shown[k] += weight[k] * cosine * cosine
                sx[k] += slope * lx[step * k]
                sy[k] += slope * ly[step * k]
                sz[k] += slope * lz[step * k]
                add_channel(unit * float(red[k]), er, weight[k], cosine, above_r[k], below_r[k], squares_r[k])
                add_channel(unit * float(green[k]), eg, weight[k], cosine, above_g[k], below_g[k], squares_g[k])
                add_channel(unit * float(blue[k]), eb, weight[k], cosine, above_b[k], below_b[k], squares_b[k])
        for k in range(pack):
            pixel = p * pack + k
            albedo[0, pixel] = albedo_of(above_r[k], below_r[k])
            albedo[1, pixel] = albedo_of(above_g[k], below_g[k])
            albedo[2, pixel] = albedo_of(above_b[k], below_b[k])
            squares[0, pixel] = squares_of(above_r[k], below_r[k], squares_r[k])
            squares[1, pixel] = squares_of(above_g[k], below_g[k], squares_g[k])
            squares[2, pixel] = squares_of(above_b[k], below_b[k], squares_b[k])
            full = (sent_r[k] * albedo[0, pixel] + sent_g[k] * albedo[1, pixel] + sent_b[k] * albedo[2, pixel]) / wp.pi
            bounced[pixel] = wp.where(full > 0.0, behind[k] / wp.max(full, 1.0e-30), -1.0)
            per = wp.where(shown[k] > 0.0, 1.0 / wp.max(shown[k], 1.0e-30), 0.0)
            openness[pixel] = per
            steep = wp.vec3(sx[k], sy[k], sz[k])
            n = wp.vec3(nx[k], ny[k], nz[k])
            tilt[pixel] = per * wp.length(steep - wp.dot(steep, n) * n)

    return albedo_kernel
