"""Material of pixels with known normals: diffuse albedo, F0 and roughness of Relit's BRDF, by a search over roughness.

For each roughness the readings of a channel are linear in albedo ρ and F0: y = ρ f_d + F0 (1 - s) f_s + s f_s, with f_d the
diffuse lobe, f_s the GGX lobe without Fresnel and s Schlick's rise; both are fitted by re-weighted non-negative least squares.
The roughness of least cost is taken from a grid and halved steps about its best.

Highlights of dielectrics have the colour of the light, so the three channels share one F0, as low as that of dielectrics is, unless
that costs clearly more. Then the surface is a metal, without diffuse reflection, or lies between both, as textures blend them: of base
colour b and metalness m the albedo is (1 - m) b and F0 is (1 - m) F + m b, with F of the dielectric, which has as many unknowns as one F0
beside an albedo. Pixels that saw no highlight cannot tell F0 from roughness: they take the materials that the object's pixels share
(`shared_materials`), in the mixture that explains them, wherever that explains them about as well as a material of their own.

A pixel of a dielectric whose F0 is far above those that the object's dielectrics share is searched again. For a narrow highlight, which few
lights show, several roughnesses are local minima of the robust cost, and weights that begin with those of another roughness can take the
brightest reading for an outlier: so each roughness begins anew, with a free F0 and with one that is shared, since dielectrics differ more
in roughness than in F0. The shared F0 is taken where it explains the pixel about as well.

Sources: the BRDF is that of `kernels.microfacet` (Walter et al., EGSR 2007; Heitz, JCGT 2014; Schlick 1994; Burley 2012); non-negative
least squares after Lawson and Hanson, "Solving Least Squares Problems", 1974, chapter 23; highlights of the light's colour after Shafer,
"Using color to separate reflection components", Color Research and Application 1985; base colour and metalness after Burley 2012.
"""

from typing import NamedTuple

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.errors import ArrayError
from kernels.packs import pack_type
from kernels.photometric.material.material_kernel import GIVEN, GIVEN_F0, METALLIC, NEUTRAL, TINTED, material_kernel
from kernels.photometric.model.chosen_samples import choose, either, put
from kernels.photometric.model.lobes import direction_reflectance
from kernels.photometric.model.response_table import COLUMNS
from kernels.photometric.model.robust_weights import WEIGHT_ROWS
from kernels.photometric.model.samples import Samples, per_pixel, scratch_memory, to_host
from kernels.photometric.model.tabulated_lobes import tabulated_reflectance
from kernels.photometric.search.hypotheses import LobeShape, SearchOptions, criteria

NEUTRAL_RISE = 1.25
"""Factor by which the cost may rise when the channels share one F0: on coloured metals it rises at least 1.3 fold and mostly several fold,
on dielectrics hardly at all (95 % of their pixels below 1.1)."""
BRIGHTEST_DIELECTRIC = 0.2
"""Largest F0 of a dielectric: that of diamond is 0.17, and no coat is brighter, so that a surface with more is a metal, or partly one."""
METAL_DIFFUSE = 0.25
"""Largest diffuse albedo of a metal, as a fraction of its F0. A metal has no diffuse reflection, but dirt and interreflection may look like
this much; with more, a bright lobe replaces what the diffuse one misses, above all at the rim. So a dielectric takes no shared metal
beside a larger one."""
USUAL_F0 = 0.04
"""F0 of a dielectric whose object does not tell it: that of a refractive index of 1.5."""
UNFIT = 1e6
"""Cost of a material that a pixel cannot have."""
MATT = np.array([0.0, 0.0, 0.0, 1.0], dtype=np.float32)
"""F0 and roughness of a surface whose readings do not say that it is anything but matt."""
SHARED_RISE = 1.4
"""Factor by which the cost of a shared material may exceed that of the pixel's own material."""
COST_FLOOR = 0.005
"""Costs per light whose difference is below this count as equal: it is the cost of a residual of 0.07 σ at every light."""
FAR_F0 = 2.0
"""Factor by which the F0 of a dielectric pixel exceeds those that the object's dielectrics share from which on the pixel is searched again:
that between the refractive indices 1.5 and 1.8, and more than paints, plastics and skin differ. A pixel with a low F0 stays as it is: it
lacks a highlight, and one that is added where the normal is a degree off shines under the wrong light."""
BLEND = 0.02
"""Temperature of the mixture of shared materials, whose weights are exp(-(cost - best) / (blend · (best + floor))): materials whose cost is
within a few per cent of the best contribute."""


class Material(NamedTuple):
    """Material of each sampled pixel."""

    diffuse_albedo: np.ndarray  # [n, 3] float32
    specular: np.ndarray  # [n, 3] float32, F0, 0…1
    roughness: np.ndarray  # [n] float32
    cost: np.ndarray  # [n] float32, per light, as of the search


def fit_material(samples: Samples, normal: np.ndarray, *, shape: LobeShape, options: SearchOptions | None = None,
                 table: wp.array | None = None, shared: np.ndarray | None = None) -> Material:
    """Fit the material of sampled pixels; waits for the device.

    The albedo is that of the Lambertian lobe closest to the fitted diffuse lobe under the capture's lights, so that an asset renders as
    fitted. With a table a surface without any specular lobe is a candidate too, because lights behind the rim tell it from one of F0 = 0,
    whose Fresnel rise shines there; it has F0 = 0 and roughness 1.

    Args:
        normal: [n, 3] unit normals.
        options: noise and shadows, as in the search.
        table: of response_table, for lights that are not of one direction each; its diffuse lobe is Lambert's whatever the shape.
        shared: [materials, 4] F0 and roughness of shared_materials.choose_materials, not beside a table; None: every pixel has a
            material of its own.
    """
    tinted = _fit(samples, normal, shape, options, table, TINTED)
    bound = BRIGHTEST_DIELECTRIC if table is None else 1.0  # extended lights show the whole lobe, so that F0 needs no bound
    neutral = _fit(samples, normal, shape, options, table, NEUTRAL, np.full(4, bound))
    explained = neutral.cost <= NEUTRAL_RISE * tinted.cost + COST_FLOOR
    if table is not None:
        return _where(explained, neutral, tinted)
    metal = ~explained & (tinted.diffuse_albedo.mean(axis=1) < METAL_DIFFUSE * tinted.specular.mean(axis=1))
    own = _where(metal, tinted, neutral)
    tried = ~explained
    if shared is not None and not is_dielectric(shared).all():
        tried |= neutral.specular[:, 0] >= bound  # beside metals, a pixel on the bound lies beyond it
    metal |= _fit_metallic(samples, normal, own, tinted, tried, usual_f0(shared), shape=shape)
    if shared is None or not len(shared):
        return own
    fits = [fit_given(samples, normal, material, shape=shape) for material in shared]
    for fit, dielectric in zip(fits, is_dielectric(shared), strict=True):
        if not dielectric:
            fit.cost[explained & (fit.diffuse_albedo.mean(axis=1) > METAL_DIFFUSE * fit.specular.mean(axis=1))] = UNFIT
    blend = _blend(fits)
    alike = explains(blend, own)
    found = _where(alike, blend, own)
    common = np.unique(shared[is_dielectric(shared), 0])
    if not len(common):
        return found
    doubtful = np.flatnonzero(~alike & ~metal & outlying(own.specular, common))
    if not len(doubtful):
        return found
    few, there = choose(samples, doubtful), normal[doubtful]
    cold = _fit(few, there, shape, options, None, NEUTRAL, np.full(4, BRIGHTEST_DIELECTRIC), anew=True)
    one_f0 = [fit_given_f0(few, there, f0, shape=shape) for f0 in common]
    again = _reconcile(_pick(own, doubtful), cold, one_f0, _pick(blend, doubtful), common)
    put(found, doubtful, again)
    return found


def usual_f0(shared: np.ndarray | None) -> float:
    """Return F0 of the dielectric that explains most of the object: the first of [materials, 4] shared ones."""
    if shared is None or not len(known := shared[is_dielectric(shared) & (shared[:, 0] > 0), 0]):
        return USUAL_F0
    return float(known[0])


def outlying(specular: np.ndarray, common: np.ndarray) -> np.ndarray:
    """Return which F0, [n, 3] of dielectrics, exceed the largest of the common ones, [values], by more than FAR_F0."""
    return np.asarray(specular[:, 0] > FAR_F0 * common.max())


def explains(shared: Material, own: Material) -> np.ndarray:
    """Return where what pixels share explains them about as well as a material of their own."""
    return np.asarray(shared.cost <= SHARED_RISE * own.cost + COST_FLOOR)


def is_dielectric(materials: np.ndarray) -> np.ndarray:
    """Return which materials, [materials, 4] F0 and roughness, are dielectrics: F0 is the same in all channels and low."""
    return np.asarray((np.ptp(materials[:, :3], axis=1) == 0) & (materials[:, 0] <= BRIGHTEST_DIELECTRIC))


def fit_tinted(samples: Samples, normal: np.ndarray, *, shape: LobeShape) -> Material:
    """Fit the material of sampled pixels with an F0 for each channel: the fit with the most unknowns, and so the least cost."""
    return _fit(samples, normal, shape, None, None, TINTED)


def fit_given(samples: Samples, normal: np.ndarray, material: np.ndarray, *, shape: LobeShape) -> Material:
    """Fit the albedo of sampled pixels to a specular lobe that is given: `material` is [4] F0 and roughness."""
    return _fit(samples, normal, shape, None, None, GIVEN, material)


def fit_given_f0(samples: Samples, normal: np.ndarray, f0: float, *, shape: LobeShape) -> Material:
    """Fit albedo and roughness of sampled pixels to an F0 that is given, of all channels.

    Each roughness begins with the weights of readings without misfit.
    """
    return _fit(samples, normal, shape, None, None, GIVEN_F0, np.full(4, f0), anew=True)


def _fit(samples: Samples, normal: np.ndarray, shape: LobeShape, options: SearchOptions | None, table: wp.array | None, freedom: int,
         given: np.ndarray | None = None, *, anew: bool = False) -> Material:
    if table is not None and table.shape[1:] != (samples.light_count, COLUMNS):
        raise ArrayError(f"table is {table.shape}, the samples have {samples.light_count} lights: give their response table")
    device, lanes, packs = samples.device, samples.lanes, samples.packs
    reflectance = direction_reflectance(lanes) if table is None else tabulated_reflectance(lanes)
    fitted = wp.empty((8, packs), dtype=pack_type(lanes, wp.float32), device=device)
    responses = wp.empty((0, 0, 0), dtype=wp.float32, device=device) if table is None else table
    known = wp.vec4() if given is None else wp.vec4(*map(float, given))
    scratch = scratch_memory(samples, reflectance.held + WEIGHT_ROWS)
    devices.launch(material_kernel(lanes, reflectance, table is not None), packs,
                   [samples.arrays, responses, per_pixel(samples, normal), criteria(options, shape), freedom, int(anew), known],
                   [scratch, fitted], device=device)
    values = to_host(samples, fitted)
    return Material(values[:, :3], values[:, 3:6], np.where(values[:, 6] > 0, values[:, 6], 1).astype(np.float32),
                    values[:, 7] / samples.light_count)


def _fit_metallic(samples: Samples, normal: np.ndarray, own: Material, tinted: Material, tried: np.ndarray, f0: float, *,
                  shape: LobeShape) -> np.ndarray:
    """Replace the materials in `own` of pixels between dielectric and metal, and return which they are.

    Args:
        own: what a dielectric or a metal makes of every pixel.
        tinted: what an F0 of each channel beside any albedo makes of it.
        tried: [n] bool.
        f0: of the dielectric.
    """
    at = np.flatnonzero(tried)
    if len(at):
        found = _fit(choose(samples, at), normal[at], shape, None, None, METALLIC, np.full(4, f0))
        better = (found.cost < own.cost[at]) & (found.cost <= NEUTRAL_RISE * tinted.cost[at] + COST_FLOOR)
        at = at[better]
        put(own, at, _pick(found, np.flatnonzero(better)))
    return np.isin(np.arange(len(tried)), at)


def _reconcile(own: Material, cold: Material, one_f0: list[Material], blend: Material, common: np.ndarray) -> Material:
    """Return the materials of dielectric pixels whose own F0 is far above the `common` ones.

    `own` and `cold` have an F0 of the pixel's own, from two starts, `one_f0` each of the common ones, `blend` is of the shared materials.
    """
    own = _where(cold.cost < own.cost, cold, own)
    best = one_f0[0]
    for other in one_f0[1:]:
        best = _where(other.cost < best.cost, other, best)
    found = _where(outlying(own.specular, common) & explains(best, own), best, own)
    return _where(explains(blend, own), blend, found)


def _pick(material: Material, positions: np.ndarray) -> Material:
    """Return the material of some pixels."""
    return Material(*(plane[positions] for plane in material))


def _where(first: np.ndarray, a: Material, b: Material) -> Material:
    """Return the first material where `first` is true, else the second."""
    return Material(*either(first, a, b))


def _blend(fits: list[Material]) -> Material:
    """Return the mean of the fits, each weighted by how close its cost is to the pixel's best; the cost returned is the best one."""
    costs = np.stack([fit.cost for fit in fits])
    best = costs.min(axis=0)
    weights = np.exp(-(costs - best) / (BLEND * (best + COST_FLOOR)))
    weights /= weights.sum(axis=0)
    albedo, specular = (np.einsum("mn,mnc->nc", weights, np.stack(planes)) for planes in
                        ([fit.diffuse_albedo for fit in fits], [fit.specular for fit in fits]))
    roughness = np.einsum("mn,mn->n", weights, np.stack([fit.roughness for fit in fits]))
    return Material(*(x.astype(np.float32) for x in (albedo, specular, roughness, best)))
