"""Float64 twins for spherical gradients: surfaces integrated numerically over the sphere of light, and least squares per pixel;
they import nothing of ours.

Ma et al. 2007 (gradients), Walter et al. 2007 equation 33 (GGX), Heitz 2014 equation 99 (height-correlated masking),
Schlick 1994 equation 15 (Fresnel).
"""

import numpy as np

AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0), "full": (0.0, 0.0, 0.0)}


def radiance_of(directions, axis, sign):
    """[...] radiance of the gradient sphere in unit directions [..., 3]."""
    if axis == "full":
        return np.ones(directions.shape[:-1])
    return (1 + sign * (directions @ AXES[axis])) / 2


def frame_about(normal):
    """[3, 3] rows: two tangents and the normal."""
    helper = np.array([1.0, 0, 0]) if abs(normal[0]) < 0.7 else np.array([0, 1.0, 0])
    tangent = np.cross(normal, helper)
    tangent /= np.linalg.norm(tangent)
    return np.stack([tangent, np.cross(normal, tangent), normal])


def polar(cosine, turn):
    """[cosine, turn, 3] unit vectors about z."""
    ring = np.sqrt(1 - cosine**2)[:, None]
    return np.stack(np.broadcast_arrays(ring * np.cos(turn), ring * np.sin(turn), cosine[:, None]), axis=-1)


def lambert(normal, axis, sign, *, nodes=24, turns=48):
    """Radiance of a convex Lambertian surface of albedo one: 1/π ∫ L cos θ dω over its hemisphere, by quadrature."""
    x, w = np.polynomial.legendre.leggauss(nodes)
    cosine, weight = (x + 1) / 2, w / 2
    turn = (np.arange(turns) + 0.5) * 2 * np.pi / turns
    local = polar(cosine, turn)
    light = radiance_of(local @ frame_about(normal), axis, sign)
    return (light * (weight * cosine)[:, None]).sum() * 2 * np.pi / turns / np.pi


def ggx(normal, view, axis, sign, *, alpha, f0, nodes=200, turns=360):
    """Radiance of a GGX lobe towards `view`: ∫ D F G / (4 n·l n·v) L n·l dω, over half vectors drawn as D draws them.

    With tan²θ = α² u / (1 - u), D(h) n·h dω_h = du dφ / 2π, and dω_l = 4 v·h dω_h.
    """
    x, w = np.polynomial.legendre.leggauss(nodes)
    u, weight = (x + 1) / 2, w / 2
    turn = (np.arange(turns) + 0.5) * 2 * np.pi / turns
    cosine = 1 / np.sqrt(1 + alpha**2 * u / (1 - u))
    local = polar(cosine, turn)
    half = local @ frame_about(normal)
    vh, nv = half @ view, normal @ view
    light = 2 * vh[..., None] * half - view
    nl = light @ normal
    seen = (nl > 0) & (vh > 0)
    nl = np.where(seen, nl, 1)
    root = nl * np.sqrt(alpha**2 + (1 - alpha**2) * nv**2) + nv * np.sqrt(alpha**2 + (1 - alpha**2) * nl**2)
    masking = 2 * nl * nv / root
    fresnel = f0 + (1 - f0) * (1 - np.clip(vh, 0, 1)) ** 5
    value = np.where(seen, masking * fresnel * radiance_of(light, axis, sign) * vh / (nv * cosine[:, None]), 0)
    return (value * weight[:, None]).sum() / turns


def fit(readings, frames):
    """M₀ and M of one pixel by least squares.

    Args:
        readings: [frame].
        frames: (axis, sign) of each.

    Returns:
        [4]: M₀, M.
    """
    rows = [(1.0, 0, 0, 0) if axis == "full" else (0.5, *(0.5 * sign * np.array(AXES[axis]))) for axis, sign in frames]
    return np.linalg.lstsq(np.array(rows), readings, rcond=None)[0]


def halfway(moments, view):
    """The unit normal halfway between the lobe's centroid and the view."""
    h = moments[1:] / np.linalg.norm(moments[1:]) + view
    return h / np.linalg.norm(h)
