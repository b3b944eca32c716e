"""The share of a pixel's light that its material does not account for, and of the light of its material that the pixel does not show.

A robust fit takes readings far above its prediction for outliers, and may explain all others. Where these few hold most of the light, the
explanation is wrong: nothing adds to what a surface reflects but light of other surfaces, which is weaker. Readings far below their
prediction are taken for shadows; a metal whose highlights all fall into shadow explains as dark a pixel as one likes.
"""

from typing import Any, NamedTuple

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.device import once
from kernels.microfacet import INVERSE_PI, ggx_seen, masking_root, schlick
from kernels.packs import pack_type, vector_at
from kernels.photometric.material.albedo_error import FittedMaterial
from kernels.photometric.model.samples import Samples, per_pixel, samples_type, to_host

LOST_SHARE = 0.3
"""Share of all light of a pixel by which readings exceed their predictions from which on its material is doubted: right dielectrics lose
0.02 to 0.1, at the 95th percentile up to 0.25, dielectrics that stand for a metal 0.5 to 0.9."""
LOST_ALBEDO = 0.1
"""The same as the albedo of a Lambertian surface that would reflect it: more than the highlight of a dielectric, of F0 0.04 to 0.17."""
SUMS = 5
"""Sums over the lights that the kernel returns."""


class LightAccount(NamedTuple):
    """The light of each sampled pixel beside that which its material predicts."""

    misread: np.ndarray  # [n] float64, share of the light by which readings and predictions differ where the material loses light; else 0
    shown: np.ndarray  # [n] float64, share of the predicted light that the readings show, 0…1


def account_light(samples: Samples, normal: np.ndarray, fitted: FittedMaterial) -> LightAccount:
    """Compare the readings of sampled pixels with the predictions of their materials; waits for the device.

    `normal`: [n, 3] unit. `fitted`: of these normals."""
    sums = wp.empty((SUMS, samples.packs), dtype=pack_type(samples.lanes, wp.float32), device=samples.device)
    given = np.concatenate([normal, fitted.diffuse_albedo.mean(axis=1, keepdims=True), fitted.specular.mean(axis=1, keepdims=True),
                            fitted.roughness[:, None]], axis=1)
    devices.launch(_account_kernel(samples.lanes), samples.packs, [samples.arrays, per_pixel(samples, given.astype(np.float32))], [sums],
                   device=samples.device)
    over, apart, whole, white, predicted = to_host(samples, sums).astype(np.float64).T
    loses = (over > LOST_SHARE * whole) & (over > LOST_ALBEDO * white)
    return LightAccount(np.where(loses, apart / np.maximum(whole, 1e-12), 0), 1 - (apart - over) / np.maximum(predicted, 1e-12))


@once
def _account_kernel(lanes: int) -> Any:
    lane_type, samples_struct = pack_type(lanes, wp.float32), samples_type(lanes)

    @wp.kernel(enable_backward=False, module="unique", module_options={"max_unroll": 0})
    def account_kernel(first: int,
                       samples: samples_struct,
                       fitted: wp.array2d(dtype=lane_type),  # [6, P] normal, grey albedo, grey F0, roughness
                       # outputs
                       sums: wp.array2d(dtype=lane_type)):  # [SUMS, P] readings above their prediction; both differences; readings;
                       # those of a white Lambertian surface; predictions
        p = first + wp.tid()
        nx, ny, nz = vector_at(fitted, p)
        vx, vy, vz = vector_at(samples.view, p)
        albedo, f0, rough = fitted[3, p], fitted[4, p], fitted[5, p]
        nv, alpha, view_root = lane_type(), lane_type(), lane_type()
        for k in range(lanes):
            nv[k] = wp.max(nx[k] * vx[k] + ny[k] * vy[k] + nz[k] * vz[k], 1.0e-3)
            alpha[k] = rough[k] * rough[k]
            view_root[k] = masking_root(nv[k], alpha[k])
        over, apart, whole, white, predicted = lane_type(), lane_type(), lane_type(), lane_type(), lane_type()
        for light in range(samples.light_count):
            element = p * samples.pack_stride + light * samples.light_stride
            lx, ly, lz = vector_at(samples.toward, element)
            y = lane_type()
            for c in range(3):
                channel = samples.colour[c, element]
                for k in range(lanes):
                    y[k] += channel[k] / 3.0
            for k in range(lanes):
                hv = wp.sqrt(wp.max(0.5 + 0.5 * (lx[k] * vx[k] + ly[k] * vy[k] + lz[k] * vz[k]), 2.5e-7))
                cosine = nx[k] * lx[k] + ny[k] * ly[k] + nz[k] * lz[k]
                nl = wp.max(cosine, 0.0)
                lobe = ggx_seen(nl, nv[k], (cosine + nv[k]) * 0.5 / hv, alpha[k], view_root[k])
                rise = schlick(hv)
                lambertian = INVERSE_PI * nl
                given = wp.where(y[k] >= 0.0, 1.0, 0.0)
                expected = given * (albedo[k] * lambertian + lobe * (f0[k] + (1.0 - f0[k]) * rise))
                off = given * y[k] - expected
                over[k] += wp.max(off, 0.0)
                apart[k] += wp.abs(off)
                whole[k] += given * y[k]
                white[k] += given * lambertian
                predicted[k] += expected
        sums[0, p] = over
        sums[1, p] = apart
        sums[2, p] = whole
        sums[3, p] = white
        sums[4, p] = predicted

    return account_kernel
