"""The reflectance model as Warp functions: Burley's diffuse lobe and GGX with Smith height-correlated masking and Schlick's Fresnel.

All directions point away from the surface; nl, nv, nh, hv are cosines between normal, light, viewer and half vector; alpha = roughness².
Values are BRDF · n·l, so that a reading (radiance / irradiance) is their sum.

Sources: Walter et al., "Microfacet models for refraction through rough surfaces", EGSR 2007, equation 33 (distribution); Heitz,
"Understanding the masking-shadowing function", JCGT 2014, equation 99 (height-correlated masking); Schlick 1994 (Fresnel);
Burley, "Physically-based shading at Disney", 2012, section 5.3 (diffuse); Oren and Nayar, "Generalization of Lambert's reflectance model",
SIGGRAPH 1994, equation 30 (rough facets).
"""

import warp as wp

INVERSE_PI = 0.31830988618
SHORT_TAILS = 18.0
"""γ of the lobes with short tails: near Beckmann's, and a power by multiplications alone."""


@wp.func
def schlick(hv: float) -> float:
    """Return Schlick's rise (1 - h·v)⁵: F = F0 + (1 - F0) · rise."""
    u = wp.max(1.0 - hv, 0.0)
    u2 = u * u
    return u2 * u2 * u


@wp.func
def masking_root(cosine: float, alpha: float) -> float:
    """Return √(α² + (1 - α²) · cosine²), the square root of `ggx`'s masking for the light or the viewer."""
    a2 = alpha * alpha
    return wp.sqrt(cosine * cosine * (1.0 - a2) + a2)


@wp.func
def masking_slope(cosine: float, alpha: float, root: float) -> float:
    """Return the derivative of masking_root by the cosine, where it is `root`."""
    return cosine * (1.0 - alpha * alpha) / root


@wp.func
def ggx_seen(nl: float, nv: float, nh: float, alpha: float, view_root: float) -> float:
    """Return `ggx`; `view_root` is masking_root(nv, alpha), the same for all lights."""
    a2 = alpha * alpha
    bottom = nh * nh * (a2 - 1.0) + 1.0
    masking = nl * view_root + nv * masking_root(nl, alpha)
    lobe = wp.static(0.5 * INVERSE_PI) * a2 * nl / (bottom * bottom * wp.max(masking, 1.0e-6))
    return wp.where(nl > 0.0, lobe, 0.0)


@wp.func
def ggx(nl: float, nv: float, nh: float, alpha: float) -> float:
    """Return D · V · n·l without Fresnel; 0 for a light below the horizon."""
    return ggx_seen(nl, nv, nh, alpha, masking_root(nv, alpha))


@wp.func
def short_tails(nh: float, alpha: float):
    """Return by what GGX's distribution of facets is multiplied to become one with short tails, and the derivative by nh.

    GGX's is Student's t-distribution of slopes with γ = 2, and Beckmann's with γ = ∞; this is the one with γ = SHORT_TAILS.
    Source: Ribardière et al., "STD: Student's t-distribution of slopes for microfacet based BSDFs", Computer Graphics Forum 36(2), 2017,
    equation 12.
    """
    a2 = alpha * alpha
    wide = wp.static(SHORT_TAILS - 1.0) * a2
    rest, wide_rest = 1.0 - a2, 1.0 - wide
    c = wp.max(nh, 1.0e-3)  # a half vector behind the surface belongs to a light that does not reach it
    bottom = wp.max(1.0 - rest * c * c, 1.0e-9)
    wide_bottom = wp.max(1.0 - wide_rest * c * c, 1.0e-9)
    inverse = 1.0 / (bottom * wide_bottom * c)
    per_nh = inverse * bottom * wide_bottom
    per_wide = inverse * bottom * c
    fall = wide * c * c * per_wide
    fall2 = fall * fall
    fall4 = fall2 * fall2
    fall8 = fall4 * fall4
    ratio = wp.static(SHORT_TAILS - 1.0) * bottom * per_wide
    factor = ratio * ratio * fall8 * fall8
    steep = wp.static(2.0 * SHORT_TAILS) * wide_rest * per_wide - 4.0 * rest * inverse * wide_bottom * c
    return factor, factor * (steep * c + wp.static(2.0 * (SHORT_TAILS - 2.0)) * per_nh)


@wp.func
def faceted(nl: float, nv: float, hv2: float) -> float:
    """Return cos(φ) sin(α) tan(β) of Oren and Nayar, 0 where light and viewer are on different sides of the normal: by how much a rough
    matt surface shows the facets that face both. α is the larger of the angles to light and viewer, β the smaller."""
    return wp.max(2.0 * hv2 - 1.0 - nl * nv, 0.0) / wp.max(wp.max(nl, nv), 1.0e-3)


@wp.func
def diffuse(nl: float, nv: float, hv2: float, form: wp.vec4) -> float:
    """Return π · diffuse BRDF of albedo 1 · n·l: Burley's lobe of roughness form[0] (below 0: Lambert's) times 1 + form[1] · (1 - n·l) and
    times 1 + form[3] · `faceted`."""
    retro = wp.where(form[0] >= 0.0, 2.0 * form[0] * hv2 - 0.5, 0.0)
    facets = 1.0 + form[3] * faceted(nl, nv, hv2)
    return nl * (1.0 + form[1] * (1.0 - nl)) * (1.0 + retro * schlick(nl)) * (1.0 + retro * schlick(nv)) * facets


@wp.func
def ggx_with_slopes(nl: float, nv: float, nh: float, alpha: float, view_root: float, view_slope: float):
    """Return `ggx` and its derivatives by nh, nl, nv and α²; all are 0 for a light below the horizon.

    `view_root` is as for `ggx_seen`, and `view_slope` masking_slope of it. One division serves all but the last.
    """
    a2 = alpha * alpha
    rest = 1.0 - a2
    bottom = wp.max(1.0 - rest * nh * nh, 1.0e-9)
    light_root = wp.sqrt(nl * nl * rest + a2)
    masking = wp.max(nl * view_root + nv * light_root, 1.0e-6)
    both = bottom * masking
    inverse = wp.where(nl > 0.0, 1.0, 0.0) / (both * light_root)
    inverse_both = inverse * light_root
    per_bottom = inverse_both * masking
    per_masking = inverse_both * bottom
    per_light_root = inverse * both
    per_a2 = wp.static(0.5 * INVERSE_PI) * inverse_both * per_bottom  # 1 / (2 π bottom² masking)
    top = per_a2 * a2
    value = top * nl
    by_nh = value * per_bottom * (4.0 * rest) * nh
    by_nl = top * per_masking * (a2 * nv) * per_light_root
    by_nv = 0.0 - value * per_masking * (light_root + nl * view_slope)
    bend = nl * (1.0 - nv * nv) / view_root + nv * (1.0 - nl * nl) * per_light_root  # twice the derivative of the masking by α²
    by_a2 = per_a2 * nl - value * (2.0 * nh * nh * per_bottom + 0.5 * bend * per_masking)
    return value, by_nh, by_nl, by_nv, by_a2


@wp.func
def diffuse_with_slopes(nl: float, nv: float, hv2: float, form: wp.vec4):
    """Return `diffuse` and its derivatives by nl and nv; all are 0 for a light below the horizon."""
    slope = form[1]
    retro = wp.where(form[0] >= 0.0, 2.0 * form[0] * hv2 - 0.5, 0.0)
    lit = wp.where(nl > 0.0, 1.0, 0.0)
    u = wp.max(1.0 - nl, 0.0)
    w = wp.max(1.0 - nv, 0.0)
    u4 = u * u * u * u
    w4 = w * w * w * w
    fall = nl * (1.0 + slope * (1.0 - nl))
    toward = 1.0 + retro * u4 * u
    away = 1.0 + retro * w4 * w
    smooth = fall * toward * away
    share = faceted(nl, nv, hv2)
    facets = 1.0 + form[3] * share
    per = wp.where(share > 0.0, form[3] * smooth, 0.0) / wp.max(wp.max(nl, nv), 1.0e-3)
    by_nl = ((1.0 + slope - 2.0 * slope * nl) * toward - 5.0 * retro * u4 * fall) * away * facets
    by_nv = 0.0 - fall * toward * 5.0 * retro * w4 * facets
    by_nl -= per * (nv + wp.where(nl > nv, share, 0.0))
    by_nv -= per * (nl + wp.where(nl > nv, 0.0, share))
    return lit * smooth * facets, lit * by_nl, lit * by_nv
