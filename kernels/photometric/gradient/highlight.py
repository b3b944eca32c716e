"""The highlight of each pixel as a GGX lobe: normal, F₀ and roughness from its responses to spherical gradients.

The halfway vector of view and lobe centroid is the normal only of a lobe that is symmetric about the mirror direction; masking,
the cosine, Fresnel and the horizon make real lobes lean, by degrees when they are rough. How concentrated a lobe is, |M|/M₀,
tells its roughness almost without regard to the angle, and roughness and angle tell the lean and the part F₀ A + B of the light
that is reflected. So: the angle of the halfway vector, the roughness of that concentration at that angle, the lean of that
roughness, a better angle, and so on; then F₀ = (M₀ - B)/A in each channel.

Source: the responses are those of Ma et al. 2007, section 3.2; the inversion of a lobe's moments for its width as in Ghosh et
al., "Estimating Specular Roughness and Anisotropy from Second Order Spherical Gradient Illumination", EGSR 2009, here from the
first order and for the lobe of Relit's BRDF.
"""

from typing import NamedTuple

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.device import once
from kernels.packs import zeros
from kernels.photometric.gradient.separation import SeparatedMoments, upload_view

MIN_HIGHLIGHT = 0.01
"""Least ratio of the specular to the diffuse response: rounding to half of the readings alone causes a tenth of it."""
MIN_LOBE, MAX_LOBE = 0.1, 1.1
"""Least and largest |M|/M₀ of a highlight: a mirror has 1, the roughest lobe about 0.6, and values outside are noise."""
MIN_HALFWAY = 0.02
"""Least |r + v| of a mirror direction r and the view v: a mirror direction opposite the view is beyond grazing."""
ROUNDS = 10
"""Rounds in which angle and roughness are updated in turn: each leaves at most half of the angle's error, for the roughest lobe."""
BISECTIONS = 10
"""Steps of the bisection for the roughness, down to 2⁻¹⁰ of its range."""

MIN_ROUGHNESS, MAX_ROUGHNESS = 0.05, 1.0
"""Range of roughness in the table: below it, a lobe under a gradient equals a mirror to four digits."""
MAX_ANGLE = np.radians(85.0)
"""Largest angle between normal and view in the table, radians: beyond it, one pixel's width covers every angle."""
ROUGHNESS_STEPS, ANGLE_STEPS = 39, 69
"""Numbers of table entries over roughness and angle, 0.025 and 1.25° apart: linear interpolation then errs by at most 0.003 of a
response."""
_NODES, _TURNS = 40, 48
"""Numbers of integration nodes over the half vector's u and over half a turn."""
_ANGLE_CHUNK = 6
"""Number of view angles that are integrated at one time: it bounds the memory."""


class Highlights(NamedTuple):
    """Specular result of a band; the last axis is pixels, padded to whole packs. 0 where no highlight was found."""

    normal: wp.array  # [3, pixels] float32, unit
    f0: wp.array  # [3, pixels] float32
    roughness: wp.array  # [pixels] float32, MIN_ROUGHNESS…1; 1 where no highlight was found


def fit_highlights(parts: SeparatedMoments, grey_weights: tuple[float, float, float], view: np.ndarray, *, gain: float,
                   pixel_count: int, device: str) -> Highlights:
    """Estimate normal, F₀ and roughness of the lobe that has the highlight's responses; not synchronised on CUDA.

    Args:
        parts: responses told apart by polarisation; radiance under a full sphere of radiance one.
        grey_weights: of the channels; they add up to one.
        view: [3, pixels] float32 unit vectors from the surface to the camera, or [3, 1] for one that all share.
        gain: diffuse light over what the frames hold of it, for what counts as a highlight.
    """
    toward = upload_view(view, pixel_count, device)
    found = Highlights(zeros(pixel_count, wp.float32, device, rows=3), zeros(pixel_count, wp.float32, device, rows=3),
                       zeros(pixel_count, wp.float32, device))
    table = wp.array(lobe_table().reshape(-1, 6), dtype=_Row, device=device)
    devices.launch(_highlight_kernel, pixel_count,
                   [parts.specular, parts.diffuse.values, toward, table, wp.vec3(*grey_weights), gain], found, device=device)
    return found


def specular_normals(parts: SeparatedMoments, grey_weights: tuple[float, float, float], view: np.ndarray, *, gain: float,
                     pixel_count: int, device: str) -> wp.array:
    """Estimate normals halfway between the view and the centroid of the highlight: of a lobe symmetric about the mirror direction.

    `parts` may be told apart by polarisation or by colour; the rest is as for fit_highlights.
    Returns [3, pixels padded] float32, unit; 0 where there is no highlight to tell a normal from."""
    toward = upload_view(view, pixel_count, device)
    normal = zeros(pixel_count, wp.float32, device, rows=3)
    devices.launch(_specular_kernel, pixel_count, [parts.specular, parts.diffuse.values, toward, wp.vec3(*grey_weights), gain],
                   [normal], device=device)
    return normal


_Row = wp.types.vector(length=6, dtype=wp.float32)


@once
def lobe_table() -> np.ndarray:
    """Return the responses of a GGX lobe to the full sphere and to L = ω, over roughness and angle of view.

    With Schlick's Fresnel F = F₀ (1 - s) + s every response is F₀ A + B. In the frame of the normal z, with the mirror direction on the
    side of x, the lobe is symmetric about the plane of incidence, so that a response is (M₀, Mx, Mz). With half vectors drawn as D draws
    them, tan²θ_h = α² u / (1 - u), the integral ∫ D F G / (4 n·l n·v) n·l g(l) dω_l becomes ∫ F G v·h / (n·h n·v) g du dφ / 2π.

    Returns:
        [roughness, angle, 6] float32: A of M₀, Mx, Mz, then B of the same.

    Source:
        Walter et al., "Microfacet models for refraction through rough surfaces", EGSR 2007, equations 33 and 35; Heitz,
        "Understanding the masking-shadowing function", JCGT 2014, equation 99.

    Convention:
        Row i is roughness MIN + i · (MAX - MIN) / (ROUGHNESS_STEPS - 1), column j the angle j · MAX_ANGLE / (ANGLE_STEPS - 1).
    """
    x, w = np.polynomial.legendre.leggauss(_NODES)
    u, weight = (x + 1) / 2, w / 2
    turn = (np.arange(_TURNS) + 0.5) * np.pi / _TURNS  # half a turn: the lobe is symmetric
    angles = np.linspace(0.0, MAX_ANGLE, ANGLE_STEPS)
    table = np.zeros((ROUGHNESS_STEPS, ANGLE_STEPS, 6))
    for row, roughness in enumerate(np.linspace(MIN_ROUGHNESS, MAX_ROUGHNESS, ROUGHNESS_STEPS)):
        a2 = roughness**4
        hz = (1 / np.sqrt(1 + a2 * u / (1 - u)))[:, None]
        hx = np.sqrt(1 - hz**2) * np.cos(turn)
        for first in range(0, ANGLE_STEPS, _ANGLE_CHUNK):
            angle = angles[first : first + _ANGLE_CHUNK, None, None]
            vx, vz = -np.sin(angle), np.cos(angle)
            vh = vx * hx + vz * hz
            lx, lz = 2 * vh * hx - vx, 2 * vh * hz - vz
            seen = (lz > 0) & (vh > 0)
            nl = np.where(seen, lz, 1.0)
            masking = 2 * nl * vz / (nl * np.sqrt(a2 + (1 - a2) * vz**2) + vz * np.sqrt(a2 + (1 - a2) * nl**2))
            value = np.where(seen, masking * vh / (hz * vz), 0.0) * weight[:, None] / _TURNS
            rise = value * (1 - np.clip(vh, 0, 1)) ** 5
            responses = [(part * g).sum(axis=(1, 2)) for part in (value - rise, rise) for g in (1.0, lx, lz)]
            table[row, first : first + len(angle)] = np.stack(responses, axis=-1)
    return table.astype(np.float32)


@wp.func
def grey_level(values: wp.array2d(dtype=float), step: int, grey: wp.vec3, p: int) -> float:
    """Return the weighted sum of three rows, those of M₀ in red, green and blue."""
    return grey[0] * values[0, p] + grey[1] * values[step, p] + grey[2] * values[2 * step, p]


@wp.func
def is_highlight(s0: float, s: wp.vec3, diffuse: float) -> bool:
    """Return whether specular responses tell a direction, beside diffuse light of this radiance."""
    lobe = wp.length(s) / wp.max(s0, 1.0e-30)
    return s0 > MIN_HIGHLIGHT * diffuse and s0 > 0.0 and lobe > MIN_LOBE and lobe < MAX_LOBE


@wp.func
def halfway(s: wp.vec3, v: wp.vec3) -> wp.vec3:
    """Return the unit normal halfway between centroid and view; 0 when they are opposite."""
    h = wp.normalize(s) + v
    return wp.where(wp.length(h) > MIN_HALFWAY, wp.normalize(h), wp.vec3(0.0, 0.0, 0.0))


@wp.func
def _look_up(table: wp.array(dtype=_Row), roughness: float, angle: float) -> _Row:
    y = (roughness - MIN_ROUGHNESS) * wp.static(float((ROUGHNESS_STEPS - 1) / (MAX_ROUGHNESS - MIN_ROUGHNESS)))
    x = angle * wp.static(float((ANGLE_STEPS - 1) / MAX_ANGLE))
    i = wp.clamp(int(y), 0, wp.static(ROUGHNESS_STEPS - 2))
    j = wp.clamp(int(x), 0, wp.static(ANGLE_STEPS - 2))
    fy, fx = y - float(i), x - float(j)
    at = i * ANGLE_STEPS + j
    low = (1.0 - fx) * table[at] + fx * table[at + 1]
    high = (1.0 - fx) * table[at + ANGLE_STEPS] + fx * table[at + ANGLE_STEPS + 1]
    return (1.0 - fy) * low + fy * high


@wp.func
def _vector_at(row: _Row, s0: float) -> wp.vec2:
    # (Mx, Mz) of the lobe whose M₀ is s0
    f0 = wp.max((s0 - row[3]) / wp.max(row[0], 1.0e-6), 0.0)
    return wp.vec2(f0 * row[1] + row[4], f0 * row[2] + row[5]) / wp.max(f0 * row[0] + row[3], 1.0e-12)


@wp.func
def _fit_lobe(table: wp.array(dtype=_Row), s0: float, lobe: float, spread: float) -> wp.vec2:
    # angle between normal and view, and roughness; spread is the angle between centroid and view
    angle = wp.clamp(0.5 * spread, 0.0, wp.static(float(MAX_ANGLE)))
    roughness = float(MIN_ROUGHNESS)
    for _ in range(ROUNDS):
        low = float(MIN_ROUGHNESS)
        high = float(MAX_ROUGHNESS)
        for _b in range(BISECTIONS):
            middle = 0.5 * (low + high)
            sharper = wp.length(_vector_at(_look_up(table, middle, angle), s0)) > lobe
            low = wp.where(sharper, middle, low)
            high = wp.where(sharper, high, middle)
        roughness = 0.5 * (low + high)
        m = _vector_at(_look_up(table, roughness, angle), s0)
        lean = wp.atan2(m[0], m[1]) - angle
        angle = wp.clamp(0.5 * (spread - lean), 0.0, wp.static(float(MAX_ANGLE)))
    return wp.vec2(angle, roughness)


@wp.kernel(enable_backward=False, module="unique", module_options={"max_unroll": 0})  # unrolled: no faster, slow to compile
def _highlight_kernel(first: int,
                      specular: wp.array2d(dtype=float),  # [6, N]
                      diffuse: wp.array2d(dtype=float),  # [12, N]
                      view: wp.array2d(dtype=float),  # [3, N]
                      table: wp.array(dtype=_Row),
                      grey: wp.vec3,
                      gain: float,
                      # outputs
                      normal: wp.array2d(dtype=float),  # [3, N]
                      f0: wp.array2d(dtype=float),  # [3, N]
                      roughness: wp.array(dtype=float)):  # [N]
    p = first + wp.tid()
    s0 = grey_level(specular, 1, grey, p)
    s = wp.vec3(specular[3, p], specular[4, p], specular[5, p])
    v = wp.vec3(view[0, p], view[1, p], view[2, p])
    roughness[p] = 1.0
    if not is_highlight(s0, s, gain * grey_level(diffuse, 4, grey, p)) or wp.length(halfway(s, v)) == 0.0:
        return
    side = s - wp.dot(s, v) * v
    fit = _fit_lobe(table, s0, wp.length(s) / s0, wp.atan2(wp.length(side), wp.dot(s, v)))
    n = wp.cos(fit[0]) * v + wp.sin(fit[0]) * wp.normalize(side)
    row = _look_up(table, fit[1], fit[0])
    for c in range(3):
        normal[c, p] = n[c]
        f0[c, p] = wp.clamp((specular[c, p] - row[3]) / wp.max(row[0], 1.0e-6), 0.0, 1.0)  # a reflectance
    roughness[p] = fit[1]


@wp.kernel(enable_backward=False, module="unique")
def _specular_kernel(first: int,
                     specular: wp.array2d(dtype=float),  # [6, N]
                     diffuse: wp.array2d(dtype=float),  # [12, N]
                     view: wp.array2d(dtype=float),  # [3, N]
                     grey: wp.vec3,
                     gain: float,
                     # outputs
                     normal: wp.array2d(dtype=float)):  # [3, N]
    p = first + wp.tid()
    s = wp.vec3(specular[3, p], specular[4, p], specular[5, p])
    if is_highlight(grey_level(specular, 1, grey, p), s, gain * grey_level(diffuse, 4, grey, p)):
        n = halfway(s, wp.vec3(view[0, p], view[1, p], view[2, p]))
        for c in range(3):
            normal[c, p] = n[c]
