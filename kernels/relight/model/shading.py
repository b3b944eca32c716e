"""Solved surfaces under samples of light, shaded by Relit's BRDF with its diffuse and specular parts apart.

Radiance = Σ over the samples of V · E · (ρ/π + Σ_k a_k D_k V_k F_k) · n·l, with E the energy of a far sample or
intensity · cos^μ / distance² of a near one, V the visibility that the caller gives by rows, and a_k the shares of one material or two.
The specular part can have a profile of each pixel (kernels.relight.model.lobe_profile): a factor that depends on the angle of the half
vector.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.device import once
from kernels.errors import ArrayError
from kernels.microfacet import INVERSE_PI
from kernels.pack_access import pack_load
from kernels.packs import as_packs, channels_type, pack_type
from kernels.relight.model.sources import Sources

LEAST_ROUGHNESS = 0.05
"""Least roughness that is shaded: a smoother lobe is narrower than any sample of a light."""
LEAST_FACING = 0.02
"""Least n·v that is used: normals of pixels at the rim may point a little away from the viewer."""
WIDTHS = [3, 3, 3, 3, 3, 1, 3, 1, 1, 3]
"""Number of values of each kind of a pixel: normal, albedo, F0, view, position, roughness; F0, roughness and share of a second material;
profile of the specular part."""
PLANES = sum(WIDTHS)
"""Number of values of a pixel."""


class Surface(NamedTuple):
    """Pixels of solved maps on a device."""

    values: wp.array  # [24, P] float packs
    pixel_count: int
    device: str

    @property
    def packs(self) -> int:
        """Number of packs that cover the pixels; the last is filled up with copies of the last pixel."""
        return int(self.values.shape[1])


class SecondLobe(NamedTuple):
    """Specular lobe of the second material of pixels that mix two; the first material has what is left of each pixel."""

    specular: np.ndarray  # [n, 3] F0
    roughness: np.ndarray  # [n] 0…1
    share: np.ndarray  # [n] 0…1 of the pixel; 0: the pixel has one material


class SourcesOnDevice(NamedTuple):
    """Samples of light of one frame or of several, uploaded."""

    place: wp.array
    energy: wp.array
    axis: wp.array
    occluder: wp.array
    share: wp.array
    first: wp.array  # [frames + 1] int32: where the samples of each frame begin


def upload_surface(normal: np.ndarray, diffuse_albedo: np.ndarray, specular: np.ndarray, roughness: np.ndarray, view: np.ndarray,
                   position: np.ndarray, *, second: SecondLobe | None = None, profile: np.ndarray | None = None, device: str) -> Surface:
    """Put pixels on the device.

    Args:
        normal, diffuse_albedo, specular, view, position: [n, 3]; unit normals and directions to the viewer, F0, places in the
            camera frame.
        roughness: [n] 0…1; 0: no specular lobe, whatever F0.
        second: of pixels that mix two materials; None: there are none. The albedo is that of the whole pixel.
        profile: [n, 3] of lobe_profile.fit_profile; None: the specular part is that of the BRDF. A pixel without a lobe has no second one.
    """
    count = len(normal)
    nothing = SecondLobe(np.zeros((count, 3)), np.zeros(count), np.zeros(count))
    plain = np.tile(np.float32([1, 0, 0]), (count, 1))
    given = (normal, diffuse_albedo, specular, view, position, roughness, *(second or nothing), plain if profile is None else profile)
    planes = [np.asarray(plane, dtype=np.float32).reshape(max(count, 1), -1) for plane in given]
    widths = [plane.shape[1] for plane in planes]
    if count == 0 or widths != WIDTHS:
        raise ArrayError(f"surface has {count} pixels with {widths} values: give {WIDTHS} of one pixel or more")
    planes[-1] = planes[-1] * np.where(planes[5] > 0, np.float32(0.5 / np.pi), 0)  # 1 / 2π of D V; none where there is no lobe
    pack = devices.pack_width(device)
    padded = -(-count // pack) * pack
    values, row = np.empty((PLANES, padded), dtype=np.float32), 0
    for plane in planes:
        values[row : row + plane.shape[1], :count] = plane.T
        row += plane.shape[1]
    values[:, count:] = values[:, count - 1 : count]
    return Surface(wp.array(values.reshape(PLANES, -1, pack), dtype=pack_type(pack, wp.float32), device=device), count, device)


def upload_sources(sources: Sources, device: str, counts: Sequence[int] | None = None) -> SourcesOnDevice:
    """Put samples on the device: of one frame, or far ones for several frames, one after the other, as many samples as `counts` says."""
    if counts is not None and (sum(counts) != sources.count or sources.place[:, 3].any()):
        raise ArrayError(f"samples are {sources.count}, {int(sources.place[:, 3].sum())} of them near, for frames of {sum(counts)}: "
                         "give the far samples of all frames")
    first = np.concatenate([[0], np.cumsum([sources.count] if counts is None else counts)])
    return SourcesOnDevice(*(wp.array(values, dtype=dtype, device=device) for values, dtype in
                             zip((*sources, first), (wp.vec4, wp.vec3, wp.vec4, wp.vec3i, wp.vec3, wp.int32), strict=True)))


def shade(surface: Surface, sources: Sources, visible: wp.array | None = None) -> wp.array:
    """Return the radiance of a surface under samples of light; not synchronised on CUDA.

    Args:
        visible: [rows, P] uint8 packs, 255 where a pixel sees the occluder of that row; None: nothing is hidden.

    Returns:
        [6, pixels padded] float32 radiance on the device, diffuse RGB and specular RGB.
    """
    if visible is None:
        kind = pack_type(devices.pack_width(surface.device), wp.uint8)
        visible = wp.empty((0, surface.packs), dtype=kind, device=surface.device)
    if sources.count and sources.occluder.max() >= visible.shape[0]:
        raise ArrayError(f"sources ask for row {sources.occluder.max()} of visibility, there are {visible.shape[0]}")
    if visible.shape[1] != surface.packs:
        raise ArrayError(f"visibility has {visible.shape[1]} packs, the surface {surface.packs}: give the same pixels")
    return _shade(surface, upload_sources(sources, surface.device), visible, far=False)[0]


def shade_frames(surface: Surface, sources: SourcesOnDevice, visible: wp.array) -> wp.array:
    """Return [frames, 6, pixels padded] float32, as `shade` does for far samples of each frame; `visible` must have the rows of all."""
    return _shade(surface, sources, visible, far=True)


def _shade(surface: Surface, sources: SourcesOnDevice, visible: wp.array, *, far: bool) -> wp.array:
    pack, count = devices.pack_width(surface.device), len(sources.first) - 1
    out = wp.empty((count, 6, surface.packs * pack), dtype=wp.float32, device=surface.device)
    devices.launch(_shade_kernel(pack, far), count * surface.packs, [surface.values, *sources, visible], [as_packs(out, surface.device)],
                   device=surface.device)
    return out


@once
def lobes(pack: int) -> Any:
    """Return the Warp function that evaluates the lobes of every pixel of a pack under a sample at one place."""
    lane_type, channels, load = pack_type(pack, wp.float32), channels_type(pack), pack_load(pack, wp.float32)

    @wp.func
    def evaluate(values: wp.array2d(dtype=lane_type), p: int, place: wp.vec4, axis: wp.vec4):
        """Return n·l, [3, pack] D V F n·l summed over the materials of a pixel, the part of the energy that arrives, and t.

        t = 1 / (1 + (tan θ_h / α)²), with α of the first material, is 1 at the peak of its lobe and falls to 0.
        """
        facing, gloss, arriving, peak = lane_type(), channels(), lane_type(), lane_type()
        nx = load(values, 0, p)
        ny = load(values, 1, p)
        nz = load(values, 2, p)
        vx = load(values, 9, p)
        vy = load(values, 10, p)
        vz = load(values, 11, p)
        tx, ty, tz = lane_type(), lane_type(), lane_type()
        if place[3] > 0.0:
            px = load(values, 12, p)
            py = load(values, 13, p)
            pz = load(values, 14, p)
            for k in range(pack):
                lx = place[0] - px[k]
                ly = place[1] - py[k]
                lz = place[2] - pz[k]
                inverse = 1.0 / wp.sqrt(wp.max(lx * lx + ly * ly + lz * lz, 1.0e-20))
                tx[k] = lx * inverse
                ty[k] = ly * inverse
                tz[k] = lz * inverse
                arriving[k] = inverse * inverse
            if axis[3] > 0.0:
                for k in range(pack):
                    ahead = wp.max(-(tx[k] * axis[0] + ty[k] * axis[1] + tz[k] * axis[2]), 0.0)
                    if axis[3] != 1.0:
                        ahead = wp.pow(ahead, axis[3])
                    arriving[k] = arriving[k] * ahead
        else:
            for k in range(pack):
                tx[k] = place[0]
                ty[k] = place[1]
                tz[k] = place[2]
                arriving[k] = 1.0
        nv, nh, rise = lane_type(), lane_type(), lane_type()
        for k in range(pack):  # no branches, so that the compiler uses SIMD instructions
            facing[k] = wp.max(nx[k] * tx[k] + ny[k] * ty[k] + nz[k] * tz[k], 0.0)
            hx, hy, hz = tx[k] + vx[k], ty[k] + vy[k], tz[k] + vz[k]
            half = 1.0 / wp.sqrt(hx * hx + hy * hy + hz * hz + 1.0e-12)
            nh[k] = wp.min((nx[k] * hx + ny[k] * hy + nz[k] * hz) * half, 1.0)  # normals rounded to half may be longer: a pole
            hv = (hx * vx[k] + hy * vy[k] + hz * vz[k]) * half
            nv[k] = wp.max(nx[k] * vx[k] + ny[k] * vy[k] + nz[k] * vz[k], LEAST_FACING)
            u = wp.max(1.0 - hv, 0.0)
            rise[k] = u * u * u * u * u
        rough = load(values, 15, p)
        whole = load(values, 21, p)
        middle = load(values, 22, p)
        narrow = load(values, 23, p)
        steady, raised, factor = lane_type(), lane_type(), lane_type()
        for k in range(pack):
            a2 = _alpha_squared(rough[k])
            near = nh[k] * nh[k] * a2
            spread = near - nh[k] * nh[k] + 1.0
            below = spread * _masking(a2, facing[k], nv[k])
            inverse = 1.0 / (spread * below)
            t = near * below * inverse
            square = t * t
            fourth = square * square
            factor[k] = wp.max(whole[k] + square * (middle[k] + narrow[k] * fourth * square), 0.0)
            peak[k] = t
            shine = factor[k] * a2 * facing[k] * inverse
            raised[k] = shine * rise[k]
            steady[k] = shine - raised[k]
        for c in range(3):
            f0 = load(values, 6 + c, p)
            for k in range(pack):
                gloss[c, k] = f0[k] * steady[k] + raised[k]
        share = load(values, 20, p)
        most = float(0.0)
        for k in range(pack):
            most = wp.max(most, share[k])
        if most > 0.0:
            other = load(values, 19, p)
            for k in range(pack):
                a2 = _alpha_squared(other[k])
                spread = nh[k] * nh[k] * (a2 - 1.0) + 1.0
                below = spread * spread * _masking(a2, facing[k], nv[k])
                shine = share[k] * factor[k] * wp.min(other[k] * 1.0e6, 1.0) * a2 * facing[k] / below
                raised[k] = shine * rise[k]
                steady[k] = shine - raised[k]
            for c in range(3):
                f0 = load(values, 16 + c, p)
                for k in range(pack):
                    gloss[c, k] = (1.0 - share[k]) * gloss[c, k] + f0[k] * steady[k] + raised[k]
        return facing, gloss, arriving, peak

    return evaluate


@wp.func
def _alpha_squared(rough: float) -> float:
    a = wp.max(rough, LEAST_ROUGHNESS)
    return a * a * a * a


@wp.func
def _masking(a2: float, nl: float, nv: float) -> float:
    """Return (n·l + n·v) / 2 V: microfacet.ggx without its guards, which cannot act here and cost the sums of images 6 %."""
    return nl * wp.sqrt(nv * nv * (1.0 - a2) + a2) + nv * wp.sqrt(nl * nl * (1.0 - a2) + a2)


@wp.func
def modelled(lit: float, albedo: float, facing: float, gloss: float) -> float:
    """Return the radiance of one channel under a light of irradiance one, from what `lobes` evaluates; `lit` is the visibility."""
    return lit * (albedo * INVERSE_PI * facing + gloss)


@once
def visibility(pack: int) -> Any:
    """Return the Warp function that interpolates the visibility of a sample between the occluders around it."""
    lane_type, byte_pack, load_byte = pack_type(pack, wp.float32), pack_type(pack, wp.uint8), pack_load(pack, wp.uint8)

    @wp.func
    def seen(visible: wp.array2d(dtype=byte_pack), p: int, rows: wp.vec3i, parts: wp.vec3):
        """Return the share of a sample, 0 to 1, that each pixel of a pack sees."""
        whole = lane_type()
        for corner in range(3):
            if rows[corner] >= 0:
                v = load_byte(visible, rows[corner], p)
                part = parts[corner] * wp.static(1.0 / 255.0)
                for k in range(pack):
                    whole[k] += part * float(v[k])
            else:
                for k in range(pack):
                    whole[k] += parts[corner]
        return whole

    return seen


@once
def _shade_kernel(pack: int, far: bool) -> Any:
    lane_type, byte_pack, channels = pack_type(pack, wp.float32), pack_type(pack, wp.uint8), channels_type(pack)
    evaluate, seen, load = lobes(pack), visibility(pack), pack_load(pack, wp.float32)

    @wp.kernel(enable_backward=False, module="unique", module_options={"max_unroll": 0})
    def shade_kernel(first: int,
                     values: wp.array2d(dtype=lane_type),  # [24, P]
                     place: wp.array(dtype=wp.vec4),  # [N]
                     energy: wp.array(dtype=wp.vec3),  # [N]
                     axis: wp.array(dtype=wp.vec4),  # [N]
                     occluder: wp.array(dtype=wp.vec3i),  # [N]
                     share: wp.array(dtype=wp.vec3),  # [N]
                     begin: wp.array(dtype=wp.int32),  # [frames + 1]
                     visible: wp.array2d(dtype=byte_pack),  # [rows, P]
                     # outputs
                     out: wp.array3d(dtype=lane_type)):  # [frames, 6, P]
        thread = first + wp.tid()
        packs = values.shape[1]
        f = thread / packs
        p = thread % packs
        matt, glossy = channels(), channels()
        for n in range(begin[f], begin[f + 1]):
            facing, gloss, lit, _ = evaluate(values, p, place[n], wp.where(wp.static(far), wp.vec4(), axis[n]))
            rows = occluder[n]
            if wp.static(far):
                lit = seen(visible, p, rows, share[n])
            elif rows[0] >= 0 or rows[1] >= 0 or rows[2] >= 0:
                whole = seen(visible, p, rows, share[n])
                for k in range(pack):
                    lit[k] = lit[k] * whole[k]
            for c in range(3):
                e = energy[n][c]
                for k in range(pack):
                    matt[c, k] += e * (lit[k] * facing[k])
                    glossy[c, k] += e * (lit[k] * gloss[c, k])
        for c in range(3):
            albedo = load(values, 3 + c, p)
            for k in range(pack):
                matt[c, k] = albedo[k] * INVERSE_PI * matt[c, k]
            out[f, c, p] = matt[c]
            out[f, 3 + c, p] = glossy[c]

    return shade_kernel
