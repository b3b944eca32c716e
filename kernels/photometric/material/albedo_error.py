"""The standard deviation of the albedo of a fitted material: what the readings leave open, and how it follows the normal.

Given the normal, a reading of a channel is y = ρ f_d + F0 (1 - s) f_s + s f_s. The variance of ρ is that of weighted least squares in
which F0 and roughness are unknown too: the mean squared residual, by the weights of the robust fit, times the element of the inverse normal
equations. Dielectrics of an object have nearly the same F0, so a pixel's may be off by a part of it, and by as much as it lies from those
that the object shares; a metal's own lobe alone bounds it. Misfit beyond the noise of a camera is alike under neighbouring lights, as in
`certainty`, and many lights hardly average it.

A normal that is tilted changes f_d and f_s, and the albedo that fits best with them. That change is returned for each degree, so that
whatever makes a normal unsure makes its albedo unsure.

Source: variance from curvature and residual as in non-linear least squares (Seber and Wild, "Nonlinear Regression", 1989, section 2.1).
"""

from typing import Any, NamedTuple, Protocol

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.device import once
from kernels.microfacet import INVERSE_PI, diffuse_with_slopes, ggx_with_slopes, masking_root, masking_slope, schlick
from kernels.packs import channels_type, pack_type, vector_at
from kernels.photometric.material.material import is_dielectric
from kernels.photometric.model.candidates import tangents
from kernels.photometric.model.lobes import direction_reflectance
from kernels.photometric.model.misfit import PRIOR
from kernels.photometric.model.robust_weights import WEIGHT_ROWS, Criteria, plain_weights, weigh
from kernels.photometric.model.samples import Samples, per_pixel, samples_type, scratch_memory, scratch_type, to_host
from kernels.photometric.search.hypotheses import LobeShape, criteria
from kernels.photometric.search.survey import INFORMATIVE, noise_of

UNKNOWNS = 5
"""Unknowns of a pixel that its readings pay for: two of the normal, albedo, F0 and roughness."""
ALIKE = 0.1
"""Standard deviation of the F0 of a dielectric that the object shares, as a part of it. This and the numbers below were chosen on thirteen
path-traced objects; docs/svbrdf.md has what they are worth on others."""
UNKNOWN_F0, METAL_F0 = 0.02, 0.5
"""Standard deviation of the F0 of a dielectric that no other pixel shares, half of the usual one, and of a metal: hardly any bound."""
ROUGHNESS = 0.1
"""Standard deviation of the roughness of a surface whose readings do not tell it."""
UNAVERAGED, CAMERA = 1 / 24, 0.004
"""Part of the variance of one reading's misfit that remains however many lights there are, and the mean squared residual, in the units of a
cost, that the noise of a camera explains: 0.6 % of a reading."""
LEAST_CLOSEST = 1e-3
"""Least albedo of the Lambertian lobe that stands for a fitted one, as for metalness."""
LEAST_SPREAD = 1e-6
"""Least standard deviation of F0 that is told from none."""
HALF = 2.0**-12
"""Rounding of half floats, in which albedo is stored, as a part of it."""
SUMS = 17
"""Sums over the lights that the kernel returns."""


class FittedMaterial(Protocol):
    """Albedo, F0 and roughness of each pixel: a `Material` or an `SvbrdfFit`."""

    @property
    def diffuse_albedo(self) -> np.ndarray:
        """[n, 3]."""

    @property
    def specular(self) -> np.ndarray:
        """[n, 3] F0."""

    @property
    def roughness(self) -> np.ndarray:
        """[n]."""


class AlbedoError(NamedTuple):
    """How far the albedo of each pixel may be off."""

    own: np.ndarray  # [n, 3] standard deviation where the normal is right
    tilt: np.ndarray  # [n, 3] change for each degree that the normal is off


def albedo_error(samples: Samples, normal: np.ndarray, fitted: FittedMaterial, *, shape: LobeShape,
                 shared: np.ndarray | None) -> AlbedoError:
    """Return how far the diffuse albedo of fitted materials may be off; waits for the device.
    `normal`: [n, 3] unit. `fitted`: fitted to it with this `shape`. `shared`: [materials, 4] F0 and roughness of pixels, or None."""
    device, lanes, packs = samples.device, samples.lanes, samples.packs
    sums = wp.empty((SUMS, packs), dtype=pack_type(lanes, wp.float32), device=device)
    given = np.concatenate([normal, fitted.diffuse_albedo, fitted.specular, fitted.roughness[:, None]], axis=1)
    devices.launch(_sums_kernel(lanes), packs,
                   [samples.arrays, per_pixel(samples, given.astype(np.float32)), criteria(None, shape)],
                   [scratch_memory(samples, WEIGHT_ROWS), sums], device=device)
    values, level = (to_host(samples, packed).astype(np.float64) for packed in (sums, samples.level))
    dd, ds, ss, dr, sr, rr = values[:, :6].T[..., None]
    tilted, closest, surplus = values[:, 9:15], values[:, 15:16], np.maximum(values[:, 16:] - UNKNOWNS, 0)
    squares = values[:, 6:9] / np.maximum(level[:, None] ** 2, 1e-30)
    moderated = (surplus * squares + PRIOR * squares.mean(axis=1, keepdims=True)) / (surplus + PRIOR)
    noise = noise_of(moderated, surplus)
    alike = 1 + UNAVERAGED * samples.light_count * np.clip(1 - CAMERA / noise.mean(axis=1, keepdims=True), 0, 1)
    unit = np.maximum(level[:, None] ** 2 * noise * alike, 1e-20)  # variance of a reading of weight 1, [n, 3]
    ss, rr = ss + unit / _f0_spread(fitted.specular, shared)[:, None] ** 2, rr + unit / ROUGHNESS**2
    opened = (ds * (ds * rr - dr * sr) + dr * (dr * ss - ds * sr)) / np.maximum(ss * rr - sr**2, 1e-30)  # by F0 and roughness
    curvature = np.maximum(dd - opened, np.maximum(1e-6 * dd, 1e-20))
    unchecked = (surplus + 2) / (surplus + 1)
    own = np.hypot(closest * unchecked * np.sqrt(unit / curvature), HALF * fitted.diffuse_albedo)
    steep = closest * np.hypot(tilted[:, :3], tilted[:, 3:]) / np.maximum(dd, 1e-20)
    return AlbedoError(own, np.radians(steep) / np.sqrt(2))  # a normal that is off by σ is off by σ / √2 along each tangent


def _f0_spread(specular: np.ndarray, shared: np.ndarray | None) -> np.ndarray:
    """Return the standard deviation of F0, [n], where the readings do not tell it."""
    dielectric = is_dielectric(specular)
    known = np.zeros(0) if shared is None else np.unique(shared[is_dielectric(shared), 0])
    apart = np.abs(specular[:, :1] - known).min(axis=1) if len(known) else np.full(len(specular), UNKNOWN_F0)
    return np.asarray(np.where(dielectric, np.maximum(ALIKE * specular[:, 0] + apart, LEAST_SPREAD), METAL_F0))


@once
def _sums_kernel(lanes: int) -> Any:
    write_weights, lambertian = plain_weights(lanes), direction_reflectance(lanes).lambertian
    lane_type, samples_struct, scratch_struct = pack_type(lanes, wp.float32), samples_type(lanes), scratch_type(lanes)
    channels = channels_type(lanes)

    @wp.kernel(enable_backward=False, module="unique", module_options={"max_unroll": 0})
    def sums_kernel(first: int,
                    samples: samples_struct,
                    fitted: wp.array2d(dtype=lane_type),  # [10, P] normal, albedo, F0, roughness
                    criteria: Criteria,
                    # outputs
                    scratch: scratch_struct,  # WEIGHT_ROWS values a light
                    sums: wp.array2d(dtype=lane_type)):  # [SUMS, P] products of diffuse lobe, specular lobe and its slope by roughness;
                    # squared residuals by channel; products of the diffuse lobe and the slopes by both tilts, by channel; the albedo of
                    # the Lambertian lobe that stands for a fitted one; readings that are not shadow
        p = first + wp.tid()
        nx, ny, nz = vector_at(fitted, p)
        vx, vy, vz = vector_at(samples.view, p)
        rough = fitted[9, p]
        write_weights(samples, criteria.noise, p, 0, scratch)
        closest = lambertian(samples, criteria.form, nx, ny, nz, p)
        rho, f0 = channels(), channels()
        for c in range(3):
            albedo, mirrored = fitted[3 + c, p], fitted[6 + c, p]
            for k in range(lanes):
                rho[c, k] = albedo[k] / wp.max(closest[k], LEAST_CLOSEST)
                f0[c, k] = mirrored[k]
        ax, ay, az, ox, oy, oz = lane_type(), lane_type(), lane_type(), lane_type(), lane_type(), lane_type()
        for k in range(lanes):
            tangent, other = tangents(wp.vec3(nx[k], ny[k], nz[k]))
            ax[k] = tangent[0]
            ay[k] = tangent[1]
            az[k] = tangent[2]
            ox[k] = other[0]
            oy[k] = other[1]
            oz[k] = other[2]
        nv, va, vo, alpha, view_root, view_slope = lane_type(), lane_type(), lane_type(), lane_type(), lane_type(), lane_type()
        for k in range(lanes):
            nv[k] = wp.max(nx[k] * vx[k] + ny[k] * vy[k] + nz[k] * vz[k], 1.0e-3)
            va[k] = ax[k] * vx[k] + ay[k] * vy[k] + az[k] * vz[k]
            vo[k] = ox[k] * vx[k] + oy[k] * vy[k] + oz[k] * vz[k]
            alpha[k] = rough[k] * rough[k]
            view_root[k] = masking_root(nv[k], alpha[k])
            view_slope[k] = masking_slope(nv[k], alpha[k], view_root[k])
        dd, ds, ss, dr, sr, rr, lit = lane_type(), lane_type(), lane_type(), lane_type(), lane_type(), lane_type(), lane_type()
        squares, tilt, turn = channels(), channels(), channels()
        for light in range(samples.light_count):
            element = p * samples.pack_stride + light * samples.light_stride
            at = p * scratch.pack_stride + light * scratch.light_stride
            lx, ly, lz = vector_at(samples.toward, element)
            fd, fs, fixed, rise, d0, d1 = lane_type(), lane_type(), lane_type(), lane_type(), lane_type(), lane_type()
            s0, s1, s2 = lane_type(), lane_type(), lane_type()
            for k in range(lanes):
                hv2 = wp.max(0.5 + 0.5 * (lx[k] * vx[k] + ly[k] * vy[k] + lz[k] * vz[k]), 2.5e-7)
                hv = wp.sqrt(hv2)
                inverse = 0.5 / hv
                rise[k] = schlick(hv)
                cosine = nx[k] * lx[k] + ny[k] * ly[k] + nz[k] * lz[k]
                la = ax[k] * lx[k] + ay[k] * ly[k] + az[k] * lz[k]
                lo = ox[k] * lx[k] + oy[k] * ly[k] + oz[k] * lz[k]
                nl = wp.max(cosine, 0.0)
                lobe, by_h, by_l, by_v, by_a2 = ggx_with_slopes(nl, nv[k], (cosine + nv[k]) * inverse, alpha[k], view_root[k],
                                                                 view_slope[k])
                value, on_l, on_v = diffuse_with_slopes(nl, nv[k], hv2, criteria.form)
                fd[k] = INVERSE_PI * value
                d0[k] = INVERSE_PI * (on_l * la + on_v * va[k])
                d1[k] = INVERSE_PI * (on_l * lo + on_v * vo[k])
                fixed[k] = rise[k] * lobe
                fs[k] = lobe - fixed[k]
                s0[k] = by_h * (la + va[k]) * inverse + by_l * la + by_v * va[k]
                s1[k] = by_h * (lo + vo[k]) * inverse + by_l * lo + by_v * vo[k]
                s2[k] = by_a2 * 4.0 * alpha[k] * rough[k]
            plain = scratch.values[at]
            off2, shining, expected, w, bend = lane_type(), lane_type(), lane_type(), lane_type(), lane_type()
            for c in range(3):
                y = samples.colour[c, element]
                inverse_sigma = scratch.values[at + (1 + c) * scratch.step]
                for k in range(lanes):
                    predicted = rho[c, k] * fd[k] + f0[c, k] * fs[k] + fixed[k]
                    off = (y[k] - predicted) * inverse_sigma[k]
                    off2[k] += off * off
                    shining[k] += y[k]
                    expected[k] += predicted
            grey = samples.grey[element]
            for k in range(lanes):
                weight, _ = weigh(shining[k], expected[k], off2[k], plain[k], criteria.shadow)
                w[k] = weight
                bend[k] = s2[k] * ((f0[0, k] + f0[1, k] + f0[2, k]) / 3.0 * (1.0 - rise[k]) + rise[k])
                dd[k] += weight * fd[k] * fd[k]
                ds[k] += weight * fd[k] * fs[k]
                ss[k] += weight * fs[k] * fs[k]
                dr[k] += weight * fd[k] * bend[k]
                sr[k] += weight * fs[k] * bend[k]
                rr[k] += weight * bend[k] * bend[k]
                lit[k] += wp.where(grey[k] > INFORMATIVE, 1.0, 0.0)
            for c in range(3):
                y = samples.colour[c, element]
                for k in range(lanes):
                    left = y[k] - (rho[c, k] * fd[k] + f0[c, k] * fs[k] + fixed[k])
                    shine = f0[c, k] * (1.0 - rise[k]) + rise[k]
                    wd = w[k] * fd[k]
                    squares[c, k] += w[k] * left * left
                    tilt[c, k] += wd * (rho[c, k] * d0[k] + shine * s0[k])
                    turn[c, k] += wd * (rho[c, k] * d1[k] + shine * s1[k])
        sums[0, p] = dd
        sums[1, p] = ds
        sums[2, p] = ss
        sums[3, p] = dr
        sums[4, p] = sr
        sums[5, p] = rr
        for c in range(3):
            one, two, three = lane_type(), lane_type(), lane_type()
            for k in range(lanes):
                one[k] = squares[c, k]
                two[k] = tilt[c, k]
                three[k] = turn[c, k]
            sums[6 + c, p] = one
            sums[9 + c, p] = two
            sums[12 + c, p] = three
        sums[15, p] = closest
        sums[16, p] = lit

    return sums_kernel
