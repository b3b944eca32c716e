"""The reflectance model in float64, from the papers: GGX (Walter 2007, equation 33), Smith's height-correlated masking from its Λ
(Heitz 2014, equations 72 and 99), brushed GGX from its slopes, Schlick 1994, Burley 2012 section 5.3. Imports nothing of ours."""

import numpy as np


def unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


GGX, BECKMANN = 2.0, np.inf


def distribution(cosine, alpha, gamma=GGX):
    """D of the angle between normal and half vector."""
    square = (1 / cosine**2 - 1) / alpha**2
    fall = np.exp(-square) if np.isinf(gamma) else (1 + square / (gamma - 1)) ** -gamma
    return fall / (np.pi * alpha**2 * cosine**4)


def smith_lambda(cosine, alpha):
    """Λ of GGX for a direction at this cosine from the normal."""
    tangent2 = 1 / cosine**2 - 1
    return (np.sqrt(1 + alpha**2 * tangent2) - 1) / 2


def specular(normal, light, view, alpha, f0, gamma=GGX):
    """BRDF · n·l of a lobe; 0 for lights below the horizon. Broadcasts over leading axes."""
    half = unit(light + view)
    nl, nv = (normal * light).sum(-1), (normal * view).sum(-1)
    nh, hv = (normal * half).sum(-1), (half * view).sum(-1)
    lit = nl > 1e-9
    safe = np.where(lit, nl, 1.0)
    masking = 1 / (1 + smith_lambda(safe, alpha) + smith_lambda(nv, alpha))
    fresnel = f0 + (1 - f0) * (1 - hv) ** 5
    return np.where(lit, distribution(np.maximum(nh, 1e-6), alpha, gamma) * masking * fresnel / (4 * nv), 0.0)


def streak(normal, tangent, light, view, widths, f0):
    """BRDF · n·l of a brushed lobe with widths along and across a tangent, by the slopes of its facets (Heitz 2014, equations 81, 84 and
    99); 0 for lights below the horizon. Broadcasts over leading axes."""
    frame = np.stack([tangent, np.cross(normal, tangent), normal], axis=-2)
    light, view = (np.einsum("...ij,...j->...i", frame, way) for way in (light, view))
    half = unit(light + view)
    lit = light[..., 2] > 1e-9
    safe = np.where(lit[..., None], light, [0.0, 0.0, 1.0])
    slopes = ((half[..., :2] / np.maximum(half[..., 2:], 1e-6) / widths) ** 2).sum(-1)
    facets = 1 / (np.pi * np.prod(widths) * (1 + slopes) ** 2 * np.maximum(half[..., 2], 1e-6) ** 4)
    masked = [(np.sqrt(1 + ((way[..., :2] * widths) ** 2).sum(-1) / way[..., 2] ** 2) - 1) / 2 for way in (safe, view)]
    fresnel = f0 + (1 - f0) * (1 - (half * view).sum(-1)) ** 5
    return np.where(lit, facets * fresnel / (4 * view[..., 2] * (1 + masked[0] + masked[1])), 0.0)


def diffuse(normal, light, view, rough=None, slope=0.0, facets=0.0):
    """BRDF · n·l of the diffuse lobe of albedo one: Lambert's, or Burley's of this roughness, times 1 + slope (1 - n·l), and times
    1 + facets · max(0, cos(φ)) sin(α) tan(β) of Oren and Nayar, by the angles themselves."""
    half = unit(light + view)
    nl = np.maximum((normal * light).sum(-1), 0)
    nv, hv = (normal * view).sum(-1), (half * view).sum(-1)
    lobe = nl / np.pi * (1 + slope * (1 - nl))
    if rough is not None:
        grazing = 0.5 + 2 * rough * hv**2
        lobe = lobe * (1 + (grazing - 1) * (1 - nl) ** 5) * (1 + (grazing - 1) * (1 - nv) ** 5)
    across = [way - cosine[..., None] * normal for way, cosine in ((light, nl), (view, nv))]
    turned = (unit(across[0] + 1e-12) * unit(across[1] + 1e-12)).sum(-1)
    to_light, to_viewer = np.arccos(np.clip(nl, 0, 1)), np.arccos(np.clip(nv, 0, 1))
    facing = np.maximum(turned, 0) * np.sin(np.maximum(to_light, to_viewer)) * np.tan(np.minimum(to_light, to_viewer))
    return lobe * (1 + facets * np.where(nl > 0, facing, 0))
