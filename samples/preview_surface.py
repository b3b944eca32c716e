"""The BRDF of docs/methods.md (UsdPreviewSurface, specular workflow) as a Mitsuba 3 plug-in.

Mitsuba's `principled` has a retro-reflective diffuse lobe and `roughplastic` a Fresnel-filtered one, so
neither has an albedo that a Lambert + GGX fit could be judged against. This one is exactly

    f = rho_d / pi + D(h) V(l, v) F(v.h)

with D the GGX distribution (alpha = roughness squared), V = G2 / (4 n.l n.v) with the Smith
height-correlated masking and F Schlick's Fresnel: what Relit fits is what was rendered.

Source: Walter et al. 2007, eq. 33 (D); Heitz 2014, eq. 99 (G2); Schlick 1994, eq. 15 (F).
"""

from __future__ import annotations

PLUGIN_NAME = "relit_preview_surface"


def register(mi) -> None:
    """Make `relit_preview_surface` known to Mitsuba; `mi` is the module with an llvm or cuda variant set.

    Parameters of the plug-in: `diffuse_albedo` (RGB texture), `f0` and `roughness` (grey textures).
    """
    import drjit as dr

    def lobes(ggx, f0, wi, wo):
        """Return the GGX lobe times cosine, its half vector and its sampling density for one pair of directions."""
        half = dr.normalize(wi + wo)
        alpha_sq = dr.square(ggx.alpha_u())
        cos_i, cos_o = mi.Frame3f.cos_theta(wi), mi.Frame3f.cos_theta(wo)
        masking_i = cos_o * dr.sqrt(alpha_sq + (1 - alpha_sq) * dr.square(cos_i))
        masking_o = cos_i * dr.sqrt(alpha_sq + (1 - alpha_sq) * dr.square(cos_o))
        visibility = 0.5 / (masking_i + masking_o)
        fresnel = f0 + (1 - f0) * (1 - dr.dot(wi, half)) ** 5
        value = ggx.eval(half) * visibility * fresnel * cos_o
        density = ggx.pdf(wi, half) / (4 * dr.dot(wo, half))
        return value, density

    class PreviewSurface(mi.BSDF):
        """Lambert plus GGX on the front side; black from behind."""

        def __init__(self, props):
            mi.BSDF.__init__(self, props)
            self.diffuse_albedo = props.get_texture("diffuse_albedo", 0.5)
            self.f0 = props.get_texture("f0", 0.04)
            self.roughness = props.get_texture("roughness", 0.5)
            self.m_flags = mi.BSDFFlags.DiffuseReflection | mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.FrontSide
            self.m_components = [self.m_flags]

        def traverse(self, cb):
            for name in ("diffuse_albedo", "f0", "roughness"):
                cb.put(name, getattr(self, name), mi.ParamFlags.Differentiable)

        def _surface(self, si, active):
            """Return albedo, F0, GGX distribution and the probability of sampling the lobe at a hit."""
            albedo = self.diffuse_albedo.eval(si, active)
            f0 = self.f0.eval_1(si, active)
            alpha = dr.square(self.roughness.eval_1(si, active))
            ggx = mi.MicrofacetDistribution(mi.MicrofacetType.GGX, dr.maximum(alpha, 1e-3), True)
            cos_i = dr.clip(mi.Frame3f.cos_theta(si.wi), 0, 1)
            specular = f0 + (1 - f0) * (1 - cos_i) ** 5
            chance = dr.clip(specular / (specular + mi.luminance(albedo) + 1e-6), 0.1, 0.9)
            return albedo, f0, ggx, chance

        def eval_pdf(self, ctx, si, wo, active=True):
            albedo, f0, ggx, chance = self._surface(si, active)
            cos_o = mi.Frame3f.cos_theta(wo)
            active = active & (mi.Frame3f.cos_theta(si.wi) > 0) & (cos_o > 0)
            lobe, density = lobes(ggx, f0, si.wi, wo)
            value = albedo * (dr.inv_pi * cos_o) + lobe
            pdf = chance * density + (1 - chance) * cos_o * dr.inv_pi
            return dr.select(active, value, 0), dr.select(active, pdf, 0)

        def eval(self, ctx, si, wo, active=True):
            return self.eval_pdf(ctx, si, wo, active)[0]

        def pdf(self, ctx, si, wo, active=True):
            return self.eval_pdf(ctx, si, wo, active)[1]

        def sample(self, ctx, si, sample1, sample2, active=True):
            _, _, ggx, chance = self._surface(si, active)
            half, _ = ggx.sample(si.wi, sample2)
            use_lobe = sample1 < chance
            wo = dr.select(use_lobe, mi.reflect(si.wi, half), mi.warp.square_to_cosine_hemisphere(sample2))
            value, pdf = self.eval_pdf(ctx, si, wo, active)
            bs = dr.zeros(mi.BSDFSample3f)
            bs.wo, bs.pdf, bs.eta = wo, pdf, 1.0
            bs.sampled_type = +mi.BSDFFlags.GlossyReflection
            bs.sampled_component = 0
            return bs, dr.select(pdf > 0, value / pdf, 0)

        def to_string(self):
            return "PreviewSurface[]"

    mi.register_bsdf(PLUGIN_NAME, PreviewSurface)
