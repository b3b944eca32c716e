"""Compute the evidence of each reading for cast shadow: the odds of the reading in shadow against those of the reading without, which the
pixel's material predicts.

In shadow a reading is what other surfaces and the noise leave, some hundredths of the pixel's brightness. Lit, it is near the prediction,
which errs by a part of itself, with the tails of Cauchy's distribution, because materials are not known exactly. Where the prediction is
itself dark (the pixel turns away from the light, or a metal reflects elsewhere) both are alike, and the reading says nothing.
"""

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.device import to_numpy
from kernels.errors import ArrayError
from kernels.microfacet import ggx, schlick

wp.set_module_options({"enable_backward": False})

LEAST_PREDICTED = 0.15
"""Part of the pixel's level below which a predicted reading says nothing about shadow. The level is the brightest diffuse reading and the
mean highlight."""
LEAST_COSINE = 0.1
"""Least n·l at which a reading says anything: normals err by some degrees."""
ERROR, HIGHLIGHT_ERROR, FLOOR = 0.2, 0.6, 0.05
"""Width of lit readings about the prediction: in parts of its diffuse part, of its highlight, and of the level."""
BOUNCED = 0.1
"""Mean reading in shadow, in parts of the level: what neighbouring surfaces throw in."""
UNEXPECTED = 0.05
"""Probability that a reading in shadow is of any size."""
LARGEST_ODDS = 2.5
"""Largest logarithm of the odds of one reading, so that no single one decides."""

LEAST_FACING, LEAST_ALPHA = 0.05, 1.0e-3
"""Least n·v and GGX width with which highlights are computed."""

_INVERSE_PI = wp.constant(wp.float32(1.0 / np.pi))


@wp.func
def _highlight(n: wp.vec3, way: wp.vec3, v: wp.vec3, f0: float, alpha: float) -> float:
    """Return the specular BRDF times n·l of a light in front of the pixel."""
    h = wp.normalize(way + v)
    lobe = ggx(wp.dot(n, way), wp.max(wp.dot(n, v), LEAST_FACING), wp.dot(n, h), alpha)
    return lobe * (f0 + (1.0 - f0) * schlick(wp.dot(h, v)))


@wp.kernel
def _weigh(first: int,
           readings: wp.array2d(dtype=float),
           toward: wp.array(dtype=wp.vec3),
           normal: wp.array(dtype=wp.vec3),
           view: wp.array(dtype=wp.vec3),
           material: wp.array(dtype=wp.vec3),
           # outputs
           odds: wp.array2d(dtype=float)):
    p = first + wp.tid()
    n = normal[p]
    v = view[p]
    m = material[p]
    alpha = wp.max(m[2] * m[2], LEAST_ALPHA)
    matt, shine, facing = float(0.0), float(0.0), float(0.0)  # literals could not change inside the loop
    for light in range(toward.shape[0]):
        cosine = wp.dot(n, toward[light])
        if cosine > LEAST_COSINE:
            matt = wp.max(matt, m[0] * _INVERSE_PI * cosine)
            if m[1] > 0.0:
                shine += _highlight(n, toward[light], v, m[1], alpha)
            facing += 1.0
    level = wp.max(matt + shine / wp.max(facing, 1.0), 1.0e-9)
    for light in range(toward.shape[0]):
        cosine, y, value = wp.dot(n, toward[light]), readings[p, light], float(0.0)
        if cosine > LEAST_COSINE and y >= 0.0:
            diffuse, highlight = m[0] * _INVERSE_PI * cosine / level, float(0.0)
            if m[1] > 0.0:
                highlight = _highlight(n, toward[light], v, m[1], alpha) / level
            if diffuse + highlight > LEAST_PREDICTED:
                width = ERROR * diffuse + HIGHLIGHT_ERROR * highlight + FLOOR
                off = (y / level - diffuse - highlight) / width
                lit = _INVERSE_PI / (width * (1.0 + off * off))
                dark = (1.0 - UNEXPECTED) * wp.exp(-y / level / BOUNCED) / BOUNCED + UNEXPECTED
                value = wp.clamp(wp.log(dark / lit), -LARGEST_ODDS, LARGEST_ODDS)
                if y / level > diffuse + highlight:
                    value = wp.min(value, 0.0)
        odds[p, light] = value


def shadow_odds(readings: np.ndarray, toward: np.ndarray, normal: np.ndarray, view: np.ndarray, material: np.ndarray, *,
                device: str) -> np.ndarray:
    """Return the logarithm of the odds that each reading lies in cast shadow; 0 where it says nothing. Waits for the device.

    Args:
        readings: [n, lights] grey radiance over irradiance; below 0 where there is none.
        toward: [lights, 3] unit directions to the lights.
        view: [n, 3] unit directions to the viewer.
        material: [n, 3] grey diffuse albedo, grey F0 (0: no highlight) and roughness.
    """
    count, lights = readings.shape
    if toward.shape != (lights, 3) or any(a.shape != (count, 3) for a in (normal, view, material)):
        raise ArrayError(f"readings are {readings.shape}, toward {toward.shape}, normal {normal.shape}, view {view.shape}, material "
                         f"{material.shape}: give one direction per light and one normal, view and material per pixel")
    odds = wp.empty((count, lights), dtype=float, device=device)
    vectors = [wp.array(np.ascontiguousarray(a, dtype=np.float32), dtype=wp.vec3, device=device) for a in (toward, normal, view, material)]
    given = wp.array(np.ascontiguousarray(readings, dtype=np.float32), dtype=float, device=device)
    devices.launch(_weigh, count, [given, *vectors], [odds], device=device)
    return to_numpy(odds)
