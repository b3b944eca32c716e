"""Responses of a GGX lobe to the full sphere and to L = ω, over roughness and angle of view: what gradient frames see of it.

With Schlick's Fresnel F = F₀ (1 - s) + s every response is F₀ A + B. In the frame of the normal z, with the mirror direction on
the side of x, the lobe is symmetric about the plane of incidence, so that a response is (M₀, Mx, Mz). With half vectors drawn as
D draws them, tan²θ_h = α² u / (1 - u), the integral ∫ D F G / (4 n·l n·v) n·l g(l) dω_l becomes
∫ F G v·h / (n·h n·v) g du dφ / 2π.

Source: Walter et al., "Microfacet models for refraction through rough surfaces", EGSR 2007, equations 33 and 35; Heitz,
"Understanding the masking-shadowing function", JCGT 2014, equation 99.
"""

from functools import cache

import numpy as np

MIN_ROUGHNESS, MAX_ROUGHNESS = 0.05, 1.0
"""Below, a lobe under a gradient is a mirror to four digits."""
MAX_ANGLE = np.radians(85.0)
"""Between normal and view; beyond, a pixel's width covers every angle."""
ROUGHNESS_STEPS, ANGLE_STEPS = 39, 69
"""Steps of 0.025 and 1.25°: linear interpolation is then good to 0.003 of a response."""
_NODES, _TURNS = 40, 48
_ANGLE_CHUNK = 6
"""Angles of view integrated at one time: bounds the memory."""


@cache
def lobe_table() -> np.ndarray:
    """[roughness, angle, 6] float32: A of M₀, Mx, Mz, then B of the same.

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
