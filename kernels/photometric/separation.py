"""Diffuse and specular responses apart: by polarisation where the rig has polarisers, by colour where it has not.

By polarisation (Malus): a highlight keeps the light's polarisation, diffuse light loses it. Behind an ideal analyser a cross
frame holds D/2 and a parallel frame D/2 + S, so S = parallel - cross and D = 2 · cross.

By colour (dichromatic reflection): the highlight of a dielectric has the colour of the light, here white. The part of a colour
that is perpendicular to white is diffuse alone, whatever the highlight is (Mallick et al. 2005), and its responses give the
diffuse shading t = M/M₀. How much white the diffuse colour itself holds is seen where the highlight is not: two gradients add
up to the light (1 - r·ω)/2 that is dark at the mirror direction r of the normal, under which a sharp highlight gives nothing:
M₀ - r·M = ρ(1 - r·t), so ρ = (M₀ - r·M)/(1 - r·t) in each channel, and the rest is specular. A grey diffuse colour has no
part perpendicular to white: there nothing is separated, and the result says by how much a highlight may mislead.

Source: Mallick, Zickler, Kriegman and Belhumeur, "Beyond Lambert: Reconstructing Specular Surfaces Using Color", CVPR 2005,
section 3; Shafer, "Using color to separate reflection components", 1985.
"""

from functools import cache
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.errors import ArrayError
from kernels.packs import as_packs, pack_type, scalars
from kernels.photometric.moments import Moments
from kernels.status import OK

MIN_CHROMA = 0.1
"""Least part of a colour that is perpendicular to white: below, noise would be multiplied by more than ten."""
MIN_SHADING = 0.2
"""Least 1 - r·t: at least 1/3 on any surface, since a response to light from one hemisphere has |t| ≤ 2/3 when it is diffuse."""
HIDDEN_TILT = 0.1
"""Radians: a highlight of F₀ 0.04 on diffuse grey of 0.5, its mirror direction 60° off the normal, adds 0.04·sin 60° across to
(2/3)·0.5 + 0.04·cos 60° along: what an unseen highlight may tilt a normal by."""


class Separation(NamedTuple):
    """Responses of a band, told apart; the last axis is pixels, padded to whole packs."""

    diffuse: Moments
    specular: wp.array  # [6, pixels] float32, of the highlight: M₀ in red, green, blue, then grey M; 0 where not separated


def separate_polarised(cross: Moments, parallel: Moments, grey_weights: tuple[float, float, float], *,
                       pixel_count: int, device: str) -> Separation:
    """Specular = parallel - cross; the diffuse responses are those of the cross frames, of half the diffuse light.

    Args:
        cross: responses of the cross-polarised frames.
        parallel: of the parallel-polarised ones.
        grey_weights: of the channels; they add up to one.
        pixel_count: pixels of the band.
        device: where the responses are.
    """
    specular = scalars(pixel_count, 6, wp.float32, device)
    inputs = [as_packs(array, device) for array in (cross.values, cross.status, parallel.values, parallel.status)]
    devices.launch(_difference_kernel(devices.pack_width(device)), inputs[0].shape[1], [*inputs, wp.vec3(*grey_weights)],
                   [as_packs(specular, device)], device=device)
    return Separation(cross, specular)


def separate_by_colour(mixed: Moments, view: np.ndarray, *, pixel_count: int, device: str) -> Separation:
    """Diffuse and specular responses of unpolarised frames, where the diffuse colour is not grey.

    Args:
        mixed: responses of the unpolarised frames.
        view: [3, pixels] float32 unit vectors from the surface to the camera, or [3, 1] for one that all share.
        pixel_count: pixels of the band.
        device: where the responses are.

    Returns:
        New responses. Where nothing is separated the diffuse ones are the mixed ones, and `tilt` is HIDDEN_TILT.

    Raises:
        ArrayError: view has another number of pixels.
    """
    toward = upload_view(view, pixel_count, device)
    diffuse = Moments(*(wp.clone(array) for array in mixed))
    specular = scalars(pixel_count, 6, wp.float32, device)
    outputs = [as_packs(array, device) for array in (diffuse.values, diffuse.variance, diffuse.tilt, specular)]
    devices.launch(_colour_kernel(devices.pack_width(device)), outputs[0].shape[1],
                   [as_packs(toward, device), as_packs(mixed.status, device)], outputs, device=device)
    return Separation(diffuse, specular)


def upload_view(view: np.ndarray, pixel_count: int, device: str) -> wp.array:
    """View vectors on the device, [3, pixels padded to whole packs].

    Raises:
        ArrayError: view is neither [3, pixels] nor [3, 1].
    """
    if view.shape not in ((3, pixel_count), (3, 1)):
        raise ArrayError(f"view is {view.shape}, the band has {pixel_count} pixels: give [3, {pixel_count}], or [3, 1] for all")
    padded = -(-pixel_count // devices.pack_width(device)) * devices.pack_width(device)
    values = np.zeros((3, padded), dtype=np.float32)
    values[:, :pixel_count] = view
    return wp.array(values, dtype=wp.float32, device=device)


@cache
def _difference_kernel(pack: int) -> Any:
    float_pack, int_pack = pack_type(pack, wp.float32), pack_type(pack, wp.int32)

    @wp.kernel(enable_backward=False, module="unique")
    def difference_kernel(first: int,
                          cross: wp.array2d(dtype=float_pack),  # [12, P]
                          cross_status: wp.array(dtype=int_pack),  # [P]
                          parallel: wp.array2d(dtype=float_pack),  # [12, P]
                          parallel_status: wp.array(dtype=int_pack),  # [P]
                          grey: wp.vec3,
                          # outputs
                          specular: wp.array2d(dtype=float_pack)):  # [6, P]
        p = first + wp.tid()
        both = float_pack()
        for k in range(pack):
            both[k] = wp.where(cross_status[p][k] == OK and parallel_status[p][k] == OK, 1.0, 0.0)
        for c in range(3):
            level = float_pack()
            for k in range(pack):
                level[k] = both[k] * (parallel[4 * c, p][k] - cross[4 * c, p][k])
            specular[c, p] = level
        for i in range(1, 4):
            along = float_pack()
            for k in range(pack):
                along[k] = both[k] * (grey[0] * (parallel[i, p][k] - cross[i, p][k])
                                      + grey[1] * (parallel[4 + i, p][k] - cross[4 + i, p][k])
                                      + grey[2] * (parallel[8 + i, p][k] - cross[8 + i, p][k]))
            specular[2 + i, p] = along

    return difference_kernel


@cache
def _colour_kernel(pack: int) -> Any:
    float_pack, int_pack = pack_type(pack, wp.float32), pack_type(pack, wp.int32)

    @wp.kernel(enable_backward=False, module="unique")
    def colour_kernel(first: int,
                      view: wp.array2d(dtype=float_pack),  # [3, P]
                      status: wp.array(dtype=int_pack),  # [P]
                      # outputs
                      moments: wp.array2d(dtype=float_pack),  # [12, P] in: mixed, out: diffuse
                      variance: wp.array(dtype=float_pack),  # [P] in: of the mixed, out: of the diffuse responses
                      tilt: wp.array(dtype=float_pack),  # [P]
                      specular: wp.array2d(dtype=float_pack)):  # [6, P]
        p = first + wp.tid()
        r0, rx, ry, rz = moments[0, p], moments[1, p], moments[2, p], moments[3, p]
        g0, gx, gy, gz = moments[4, p], moments[5, p], moments[6, p], moments[7, p]
        b0, bx, by, bz = moments[8, p], moments[9, p], moments[10, p], moments[11, p]
        vx, vy, vz = view[0, p], view[1, p], view[2, p]
        spread, code = variance[p], status[p]
        hidden, s0, sx, sy, sz = float_pack(), float_pack(), float_pack(), float_pack(), float_pack()
        for k in range(pack):
            m0 = wp.vec3(r0[k], g0[k], b0[k])
            mx, my, mz = wp.vec3(rx[k], gx[k], bx[k]), wp.vec3(ry[k], gy[k], by[k]), wp.vec3(rz[k], gz[k], bz[k])
            white = (m0[0] + m0[1] + m0[2]) / 3.0
            across = m0 - wp.vec3(white, white, white)
            chroma = wp.length(across) / wp.max(wp.length(m0), 1.0e-30)
            axis = wp.normalize(across)  # perpendicular to white: what it takes of a colour is diffuse
            t = wp.vec3(wp.dot(axis, mx), wp.dot(axis, my), wp.dot(axis, mz)) / wp.max(wp.length(across), 1.0e-30)
            n = wp.normalize(t)
            v = wp.vec3(vx[k], vy[k], vz[k])
            r = 2.0 * wp.dot(n, v) * n - v
            dark = 1.0 - wp.dot(r, t)
            apart = code[k] == OK and chroma > MIN_CHROMA and dark > MIN_SHADING
            rho = (m0 - (r[0] * mx + r[1] * my + r[2] * mz)) / wp.max(dark, MIN_SHADING)
            rest = m0 - rho
            rest_x, rest_y, rest_z = mx - t[0] * rho, my - t[1] * rho, mz - t[2] * rho
            if apart:
                r0[k] = rho[0]
                rx[k] = rho[0] * t[0]
                ry[k] = rho[0] * t[1]
                rz[k] = rho[0] * t[2]
                g0[k] = rho[1]
                gx[k] = rho[1] * t[0]
                gy[k] = rho[1] * t[1]
                gz[k] = rho[1] * t[2]
                b0[k] = rho[2]
                bx[k] = rho[2] * t[0]
                by[k] = rho[2] * t[1]
                bz[k] = rho[2] * t[2]
                s0[k] = (rest[0] + rest[1] + rest[2]) / 3.0
                sx[k] = (rest_x[0] + rest_x[1] + rest_x[2]) / 3.0
                sy[k] = (rest_y[0] + rest_y[1] + rest_y[2]) / 3.0
                sz[k] = (rest_z[0] + rest_z[1] + rest_z[2]) / 3.0
                spread[k] = spread[k] / (chroma * chroma)
            elif code[k] == OK:
                hidden[k] = HIDDEN_TILT
        moments[0, p] = r0
        moments[1, p] = rx
        moments[2, p] = ry
        moments[3, p] = rz
        moments[4, p] = g0
        moments[5, p] = gx
        moments[6, p] = gy
        moments[7, p] = gz
        moments[8, p] = b0
        moments[9, p] = bx
        moments[10, p] = by
        moments[11, p] = bz
        variance[p] = spread
        tilt[p] = hidden
        specular[0, p] = s0
        specular[1, p] = s0
        specular[2, p] = s0
        specular[3, p] = sx
        specular[4, p] = sy
        specular[5, p] = sz

    return colour_kernel
