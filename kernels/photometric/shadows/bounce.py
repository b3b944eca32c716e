"""Interreflection: light that reached a pixel from the surface around it is subtracted from its readings.

Under one light a patch of albedo ρ sends ρ times the light that arrives at it; what arrives from other patches follows from the form
factors between them (`surface.interreflection`) and the albedo found so far, and is taken off before the next fit.

Sources: Goral, Torrance, Greenberg and Battaile, "Modeling the interaction of light between diffuse surfaces", SIGGRAPH 1984
(radiosity); Nayar, Ikeuchi and Kanade, "Shape from interreflections", IJCV 1991 (shape and interreflection corrected in turn).
"""

from typing import Any

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.device import once
from kernels.errors import ArrayError
from kernels.packs import pack_type, vector_at
from kernels.photometric.lambertian.near import NearField, falloff
from kernels.photometric.material.material import MATT, METAL_DIFFUSE, Material, fit_given
from kernels.photometric.model.samples import Samples, per_pixel, samples_type
from kernels.photometric.search.hypotheses import LobeShape


def bounce_albedo(samples: Samples, normal: np.ndarray, tinted: Material, *, shape: LobeShape) -> np.ndarray:
    """Return [n, 3] the part of the light from other surfaces that sampled pixels send on.

    Light from many directions hardly asks how wide a lobe is. The albedo beside a lobe of its own does, because a wide tinted lobe and the
    diffuse one replace each other: on path-traced cloth it was wrong by 42 %, that of a matt surface by 15 % (root mean squares). A metal
    sends on nothing in this sense: what it mirrors comes from one direction.
    `tinted`: of material.fit_tinted at these normals."""
    matt = fit_given(samples, normal, MATT, shape=shape).diffuse_albedo
    metal = tinted.diffuse_albedo.mean(axis=1) < METAL_DIFFUSE * tinted.specular.mean(axis=1)
    return np.where(metal[:, None], tinted.diffuse_albedo, matt)


def subtract_bounce(samples: Samples, arriving: "np.ndarray | wp.array", corners: np.ndarray, shares: np.ndarray, albedo: np.ndarray,
                    grey_weights: np.ndarray, field: NearField | None = None) -> None:
    """Subtract albedo · arriving light from the readings; a reading does not fall below zero.

    Args:
        samples: changed in place.
        arriving: [patches, 3, lights] float32: what a surface of albedo 1 at each patch sends on, per irradiance of a distant or extended
            light, or intensity of a near one; on the device of the samples or on the host.
        corners: [n, 4] int, the patches about each pixel.
        shares: [n, 4] float32, their interpolation weights.
        albedo: [n, 3] diffuse albedo of each pixel.
        grey_weights: [3], of the grey readings.
        field: places of the lights and the points of these pixels, where some light is near: the readings of the samples are divided
            by the falloff of each light there.
    """
    patches, _, lights = arriving.shape
    count = samples.pixel_count
    if corners.shape != (count, 4) or shares.shape != (count, 4) or albedo.shape != (count, 3) or lights != samples.light_count:
        raise ArrayError(f"corners are {corners.shape}, shares {shares.shape}, albedo {albedo.shape}, arriving light "
                         f"{arriving.shape}: expected {count} pixels and {samples.light_count} lights")
    if corners.min() < 0 or corners.max() >= patches:
        raise ArrayError(f"corners must be from 0 to {patches - 1}")
    if field is not None and (field.points.shape != (3, count) or len(field.places.place) < lights):
        raise ArrayError(f"points are {field.points.shape} under {len(field.places.place)} lights, expected {(3, count)} under {lights}")
    device = samples.device
    if field is None:
        nowhere = wp.empty(0, dtype=wp.vec4, device=device)
        near = (nowhere, nowhere, wp.empty((3, 0), dtype=pack_type(samples.lanes, wp.float32), device=device))
    else:
        near = (*(wp.array(values, dtype=wp.vec4, device=device) for values in field.places), per_pixel(samples, field.points.T))
    light = arriving if isinstance(arriving, wp.array) else wp.array(arriving, dtype=wp.float32, device=device)
    devices.launch(_bounce_kernel(samples.lanes, field is not None), samples.packs,
                   [light, per_pixel(samples, corners), per_pixel(samples, shares), per_pixel(samples, albedo), *near,
                    wp.vec3(*(float(w) for w in grey_weights))], [samples.arrays], device=device)


@once
def _bounce_kernel(lanes: int, near: bool) -> Any:
    lane_type, samples_struct = pack_type(lanes, wp.float32), samples_type(lanes)

    @wp.kernel(enable_backward=False, module="unique", module_options={"max_unroll": 0})
    def bounce_kernel(first: int,
                      arriving: wp.array3d(dtype=float),  # [patches, 3, L]
                      corners: wp.array2d(dtype=lane_type),  # [4, P] patch numbers, exact in float32
                      shares: wp.array2d(dtype=lane_type),  # [4, P]
                      albedo: wp.array2d(dtype=lane_type),  # [3, P]
                      places: wp.array(dtype=wp.vec4),  # [L or padded], if near
                      lobes: wp.array(dtype=wp.vec4),  # [L or padded], if near
                      points: wp.array2d(dtype=lane_type),  # [3, P], if near
                      weights: wp.vec3,
                      # outputs
                      samples: samples_struct):
        p = first + wp.tid()
        bright = samples.level[p]
        for light in range(samples.light_count):
            at = p * samples.pack_stride + light * samples.light_stride
            taken, inverse = lane_type(), lane_type(1.0)  # inverse: 1 / falloff
            if wp.static(near):
                px, py, pz = vector_at(points, p)
                for k in range(lanes):
                    fall = falloff(places[light], lobes[light], px[k], py[k], pz[k])
                    inverse[k] = wp.where(fall > 0.0, 1.0 / wp.max(fall, 1.0e-30), 0.0)
            for c in range(3):
                y = samples.colour[c, at]
                rho = albedo[c, p]
                for k in range(lanes):
                    light_in = float(0.0)  # a literal could not change inside the loop
                    for corner in range(4):
                        patch = int(corners[corner, p][k])
                        light_in += shares[corner, p][k] * arriving[patch, c, light]
                    bounced = inverse[k] * rho[k] * light_in
                    taken[k] += weights[c] * bounced
                    y[k] = wp.where(y[k] > 0.0, wp.max(y[k] - bounced, 0.0), y[k])
                samples.colour[c, at] = y
            relative = samples.grey[at]
            for k in range(lanes):
                left = wp.max(relative[k] - taken[k] / bright[k], 0.0)
                relative[k] = wp.where(relative[k] > 0.0, left, relative[k])
            samples.grey[at] = relative

    return bounce_kernel
