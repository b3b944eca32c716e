"""Slow float64 twin of objects under diffused sources, by numerical integration; it imports nothing of ours.

A source is a smooth patch of the sphere: radiance exp(κ (ω·c - 1)) in direction ω. A Lambertian pixel integrates it over an even
lattice of the sphere, a GGX pixel over half vectors drawn as D draws them, tan²θ = α² u / (1 - u) (Walter et al. 2007, equations
33 and 35, with Smith's height-correlated masking, Heitz 2014, equation 99), and a mirror shows the radiance in the reflected
direction.
"""

import numpy as np


def lattice(count: int, largest_degrees: float = 180.0) -> np.ndarray:
    """[count, 3] unit, even over the sphere, or over the cap around +z."""
    i = np.arange(count) + 0.5
    z = 1 - (1 - np.cos(np.radians(largest_degrees))) * i / count
    turn = np.pi * (1 + 5**0.5) * i
    ring = np.sqrt(1 - z * z)
    return np.stack([ring * np.cos(turn), ring * np.sin(turn), z], axis=1)


def radiance(direction: np.ndarray, centre: np.ndarray, sharpness: float) -> np.ndarray:
    """[…, lights] of directions […, 3] and centres [lights, 3]."""
    return np.exp(sharpness * (direction @ centre.T - 1))


def irradiance(sharpness: float) -> float:
    """Of a whole source, every part of it at normal incidence: ∫ exp(κ (cos θ - 1)) dω."""
    return 2 * np.pi * (1 - np.exp(-2 * sharpness)) / sharpness


def fresnel(cosine: np.ndarray, f0: float) -> np.ndarray:
    return f0 + (1 - f0) * np.clip(1 - cosine, 0, 1) ** 5


def lambert(normal: np.ndarray, centre: np.ndarray, sharpness: float, *, count: int = 6000) -> np.ndarray:
    """[n, lights] radiance of albedo one."""
    direction = lattice(count)
    return np.maximum(normal @ direction.T, 0) @ radiance(direction, centre, sharpness) * (4 / count)


def mirror(normal: np.ndarray, view: np.ndarray, centre: np.ndarray, sharpness: float, *, f0: float) -> np.ndarray:
    """[n, lights] radiance."""
    cosine = (normal * view).sum(-1, keepdims=True)
    return fresnel(cosine, f0) * radiance(2 * cosine * normal - view, centre, sharpness)


def ggx(normal: np.ndarray, view: np.ndarray, centre: np.ndarray, sharpness: float, *, alpha: float, f0: float,
        rings: int = 32, turns: int = 48) -> np.ndarray:
    """[n, lights] radiance."""
    nodes, weights = np.polynomial.legendre.leggauss(rings)
    u, share = (nodes + 1) / 2, weights / 2
    turn = (np.arange(turns) + 0.5) * 2 * np.pi / turns
    hz = 1 / np.sqrt(1 + alpha**2 * u / (1 - u))
    local = np.stack([np.outer(np.sqrt(1 - hz**2), np.cos(turn)), np.outer(np.sqrt(1 - hz**2), np.sin(turn)),
                      np.broadcast_to(hz[:, None], (rings, turns))], axis=-1).reshape(-1, 3)
    share = np.repeat(share, turns) / turns
    result = np.zeros((len(normal), len(centre)))
    view = np.broadcast_to(view, normal.shape)
    for p, (n, v) in enumerate(zip(normal, view, strict=True)):
        side = np.cross(n, [1.0, 0, 0] if abs(n[0]) < 0.9 else [0, 1.0, 0])
        side /= np.linalg.norm(side)
        h = local @ np.stack([side, np.cross(n, side), n])
        vh = h @ v
        light = 2 * vh[:, None] * h - v
        nl, nh, nv = light @ n, h @ n, n @ v
        seen = (vh > 0) & (nl > 0)
        nl = np.where(seen, nl, 1.0)
        a2 = alpha**2
        masking = 2 * nl * nv / (nl * np.sqrt(a2 + (1 - a2) * nv**2) + nv * np.sqrt(a2 + (1 - a2) * nl**2))
        value = np.where(seen, fresnel(vh, f0) * masking * vh / (nh * nv), 0) * share
        result[p] = value @ radiance(light, centre, sharpness)
    return result


def samples_of(centre: np.ndarray, sharpness: float, *, count: int = 4000,
               least: float = 1e-3) -> tuple[np.ndarray, np.ndarray, float]:
    """One source as a manifest holds it: directions [s, 3], radiance [s], and the solid angle of each, 4π / count."""
    direction = lattice(count)
    value = radiance(direction, centre[None], sharpness)[:, 0]
    kept = value > least
    return direction[kept], value[kept], 4 * np.pi / count
