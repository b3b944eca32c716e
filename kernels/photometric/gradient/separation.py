"""Diffuse and specular responses apart: by polarisation where the rig has polarisers, by colour where it has not.

By polarisation (Malus): a highlight keeps the light's polarisation, diffuse light loses it. Behind an ideal analyser a cross
frame holds D/2 and a parallel frame D/2 + S, so S = parallel - cross and D = 2 · cross.

By colour (dichromatic reflection): the highlight of a dielectric has the colour of the light, here white. The part of a colour
that is perpendicular to white is diffuse alone, whatever the highlight is (Mallick et al. 2005), and its responses give the
diffuse shading t = M/M₀. How much white the diffuse colour holds is seen where the highlight is not: two gradients add
up to the light (1 - r·ω)/2 that is dark at the mirror direction r of the normal, under which a sharp highlight gives nothing:
M₀ - r·M = ρ(1 - r·t), so ρ = (M₀ - r·M)/(1 - r·t) in each channel, and the rest is specular. A grey diffuse colour has no
part perpendicular to white: there nothing is separated, and the result says by how much a highlight may mislead.

Source: Mallick, Zickler, Kriegman and Belhumeur, "Beyond Lambert: Reconstructing Specular Surfaces Using Color", CVPR 2005,
section 3; Shafer, "Using color to separate reflection components", 1985.
"""

from typing import NamedTuple

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.errors import ArrayError
from kernels.packs import padded_count, zeros
from kernels.photometric.gradient.moments import Moments
from kernels.status import OK

MIN_CHROMA = 0.1
"""Least fraction of a colour that is perpendicular to white: below it, noise would be multiplied by more than ten."""
MIN_SHADING = 0.2
"""Least 1 - r·t that is divided by. On any surface it is at least 1/3, because a diffuse response to light from one hemisphere has |t| ≤
2/3."""
HIDDEN_TILT = 0.1
"""Angle in radians by which an unseen highlight may tilt a normal: a highlight of F₀ 0.04 on diffuse grey of 0.5, its mirror direction 60°
off the normal, adds 0.04·sin 60° across to (2/3)·0.5 + 0.04·cos 60° along."""


class SeparatedMoments(NamedTuple):
    """Responses of a band, told apart; the last axis is pixels, padded to whole packs."""

    diffuse: Moments
    specular: wp.array  # [6, pixels] float32, of the highlight: M₀ in red, green, blue, then grey M; 0 where not separated


def separate_polarised(cross: Moments, parallel: Moments, grey_weights: tuple[float, float, float], *, leak: float = 0.0,
                       pixel_count: int, device: str) -> SeparatedMoments:
    """Separate responses by polarisation: specular = (parallel - cross) / (1 - 2 leak).

    The diffuse responses are those of the cross frames less the part of the highlight that leaks, of half the diffuse light.
    `grey_weights`: of the channels; they add up to one. `leak`: part of a highlight's light that crossed polarisers pass, 0 to below
    0.5."""
    diffuse = Moments(*(wp.clone(array) for array in cross)) if leak > 0 else cross
    specular = zeros(pixel_count, wp.float32, device, rows=6)
    devices.launch(_difference_kernel, pixel_count, [cross.values, cross.status, parallel.values, parallel.status,
                                                     wp.vec3(*grey_weights), leak], [diffuse.values, diffuse.variance, specular],
                   device=device)
    return SeparatedMoments(diffuse, specular)


def separate_by_colour(mixed: Moments, view: np.ndarray, *, pixel_count: int, device: str) -> SeparatedMoments:
    """Separate the diffuse and specular responses of unpolarised frames, where the diffuse colour is not grey.

    Where nothing is separated the diffuse responses are the mixed ones, and `tilt` is HIDDEN_TILT.
    `view`: [3, pixels] float32 unit vectors from the surface to the camera, or [3, 1] for one that all share."""
    toward = upload_view(view, pixel_count, device)
    diffuse = Moments(*(wp.clone(array) for array in mixed))
    specular = zeros(pixel_count, wp.float32, device, rows=6)
    devices.launch(_colour_kernel, pixel_count, [toward, mixed.status], [diffuse.values, diffuse.variance, diffuse.tilt, specular],
                   device=device)
    return SeparatedMoments(diffuse, specular)


def upload_view(view: np.ndarray, pixel_count: int, device: str) -> wp.array:
    """Return view vectors, [3, pixels] or [3, 1], on the device as [3, pixels padded to whole packs]."""
    if view.shape not in ((3, pixel_count), (3, 1)):
        raise ArrayError(f"view is {view.shape}, the band has {pixel_count} pixels: give [3, {pixel_count}], or [3, 1] for all")
    values = np.zeros((3, padded_count(pixel_count, device)), dtype=np.float32)
    values[:, :pixel_count] = view
    return wp.array(values, dtype=wp.float32, device=device)


@wp.kernel(enable_backward=False, module="unique")
def _difference_kernel(first: int,
                       cross: wp.array2d(dtype=float),  # [12, N]
                       cross_status: wp.array(dtype=int),  # [N]
                       parallel: wp.array2d(dtype=float),  # [12, N]
                       parallel_status: wp.array(dtype=int),  # [N]
                       grey: wp.vec3,
                       leak: float,
                       # outputs
                       moments: wp.array2d(dtype=float),  # [12, N] in: of the cross frames, out: of half the diffuse light
                       variance: wp.array(dtype=float),  # [N] in: of the cross frames, out: of half the diffuse light
                       specular: wp.array2d(dtype=float)):  # [6, N]
    p = first + wp.tid()
    if cross_status[p] != OK or parallel_status[p] != OK:
        return
    apart = 1.0 / (1.0 - 2.0 * leak)
    for c in range(3):
        specular[c, p] = apart * (parallel[4 * c, p] - cross[4 * c, p])
    for i in range(1, 4):
        specular[2 + i, p] = apart * (grey[0] * (parallel[i, p] - cross[i, p]) + grey[1] * (parallel[4 + i, p] - cross[4 + i, p])
                                      + grey[2] * (parallel[8 + i, p] - cross[8 + i, p]))
    if leak > 0.0:
        for row in range(12):
            leaked = leak * apart * (parallel[row, p] - cross[row, p])
            moments[row, p] = cross[row, p] - leaked
        gain = 1.0 + leak * apart
        variance[p] = variance[p] * (gain * gain + leak * leak * apart * apart)


@wp.kernel(enable_backward=False, module="unique")
def _colour_kernel(first: int,
                   view: wp.array2d(dtype=float),  # [3, N]
                   status: wp.array(dtype=int),  # [N]
                   # outputs
                   moments: wp.array2d(dtype=float),  # [12, N] in: mixed, out: diffuse
                   variance: wp.array(dtype=float),  # [N] in: of the mixed, out: of the diffuse responses
                   tilt: wp.array(dtype=float),  # [N]
                   specular: wp.array2d(dtype=float)):  # [6, N]
    p = first + wp.tid()
    if status[p] != OK:
        return
    m0 = wp.vec3(moments[0, p], moments[4, p], moments[8, p])
    mx = wp.vec3(moments[1, p], moments[5, p], moments[9, p])
    my = wp.vec3(moments[2, p], moments[6, p], moments[10, p])
    mz = wp.vec3(moments[3, p], moments[7, p], moments[11, p])
    white = (m0[0] + m0[1] + m0[2]) / 3.0
    across = m0 - wp.vec3(white, white, white)
    chroma = wp.length(across) / wp.max(wp.length(m0), 1.0e-30)
    axis = wp.normalize(across)  # perpendicular to white: the component of a colour along it is diffuse
    t = wp.vec3(wp.dot(axis, mx), wp.dot(axis, my), wp.dot(axis, mz)) / wp.max(wp.length(across), 1.0e-30)
    n = wp.normalize(t)
    v = wp.vec3(view[0, p], view[1, p], view[2, p])
    r = 2.0 * wp.dot(n, v) * n - v
    dark = 1.0 - wp.dot(r, t)
    if not (chroma > MIN_CHROMA and dark > MIN_SHADING):
        tilt[p] = HIDDEN_TILT
        return
    rho = (m0 - (r[0] * mx + r[1] * my + r[2] * mz)) / dark
    rest = m0 - rho
    rest_x, rest_y, rest_z = mx - t[0] * rho, my - t[1] * rho, mz - t[2] * rho
    for c in range(3):
        moments[4 * c, p] = rho[c]
        moments[4 * c + 1, p] = rho[c] * t[0]
        moments[4 * c + 2, p] = rho[c] * t[1]
        moments[4 * c + 3, p] = rho[c] * t[2]
        specular[c, p] = (rest[0] + rest[1] + rest[2]) / 3.0
    specular[3, p] = (rest_x[0] + rest_x[1] + rest_x[2]) / 3.0
    specular[4, p] = (rest_y[0] + rest_y[1] + rest_y[2]) / 3.0
    specular[5, p] = (rest_z[0] + rest_z[1] + rest_z[2]) / 3.0
    variance[p] = variance[p] / (chroma * chroma)
    tilt[p] = 0.0
