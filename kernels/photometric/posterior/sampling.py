"""Photometric sampling: normal, material and regime of pixels under lights of any extent, mirrors included.

The search of `hypotheses` with its lobes looked up in a response table. It begins with a grid over the whole visible hemisphere (`modes`),
because a mirror has no Lambertian start, and ends with rings about the best, once under lobes with the Fresnel rise of a
dielectric and once under those of a metal; a pixel keeps the kind whose normal lets Relit's BRDF explain it better. The posterior around
that normal, and around the second-best minimum of the grid, says how far the readings leave the normal open (`posterior`). The mixture
and the material found say which regime the pixel is in.

Source: Nayar, Ikeuchi and Kanade, "Determining shape and reflectance of hybrid surfaces by photometric sampling", IEEE
Transactions on Robotics and Automation 1990; here with GGX lobes beside the Lambertian and the mirror one, and a robust
non-negative mixture of them.
"""

from dataclasses import replace
from enum import IntEnum
from typing import NamedTuple

import numpy as np
import warp as wp

from kernels.photometric.material.material import Material, fit_material
from kernels.photometric.model.chosen_samples import choose, either, put
from kernels.photometric.model.response_table import POSTERIOR_WIDTHS, SEARCH_WIDTHS, SPECULAR_SCALE, search_table
from kernels.photometric.model.samples import Samples
from kernels.photometric.posterior.modes import Modes, find_modes, weigh
from kernels.photometric.posterior.posterior import Group, bounded, measure_noise, normal_posterior
from kernels.photometric.search.hypotheses import LobeShape, RingOptions, search_normals
from kernels.photometric.search.search_kernel import SAMPLING_SWEEPS

DIELECTRIC, METAL = 0.04, 0.8
"""F0 of the two kinds of lobes. Their Fresnel rises differ, and over a wide light this moves the estimated normal by degrees."""
OPTIONS = RingOptions(noise_floor=0.05, noise_slope=0.05, sweeps=SAMPLING_SWEEPS)
"""Search options for wide lights. They cause no isolated highlights, so that a dim reading has less unexplained light than under single
lamps; for bright readings the table is accurate to a few per cent."""
AROUND, AROUND_OPTIONS = (((2.0, 4.0, 6.0), 16), ((1.0, 2.0), 8)), replace(
    OPTIONS, noise_floor=0.1, noise_slope=0.3, reweightings=2, sweeps=12)
"""Rings and options of the search about a mode of the grid over the hemisphere."""
FINE = (((1.2, 2.4, 4.0), 14), ((0.6,), 6), ((0.3,), 6), ((0.15,), 6))
"""Rings, in degrees, of the last search, which each kind of lobes makes about the best candidate."""
LEAST_DIFFUSE, LEAST_SPECULAR = 0.1, 0.05
"""Least share of the reflected light that a diffuse and a specular part must have to be counted in the regime: plastic of albedo 0.5 has
0.07 specular."""
SHARP = 0.2
"""Roughness below which a specular pixel is called a mirror: its lobe is less than 5° wide, which an extended light cannot resolve."""


class Regime(IntEnum):
    """The kind of reflection of a pixel."""

    UNSOLVED = 0
    LAMBERTIAN = 1
    """Diffuse light alone."""
    GLOSSY = 2
    """Specular light alone, spread by roughness."""
    MIRROR = 3
    """Specular light alone, not spread as far as the lights can tell."""
    MIXTURE = 4
    """Diffuse and specular light."""


class SamplingFit(NamedTuple):
    """Normal, material and regime of each sampled pixel, on the host."""

    normal: np.ndarray  # [n, 3] float32, unit
    diffuse_albedo: np.ndarray  # [n, 3] float32
    specular: np.ndarray  # [n, 3] float32, F0
    roughness: np.ndarray  # [n] float32
    regime: np.ndarray  # [n] uint8, codes of Regime
    sigma: np.ndarray  # [n] float32: standard deviation of the normal over its modes, degrees
    residual: np.ndarray  # [n] float32: root of the mean cost per light, in units of the noise


class SamplingTables(NamedTuple):
    """Tables of one set of lights."""

    responses: wp.array
    search: tuple[wp.array, wp.array]
    """Lobes of the search, with the Fresnel rise of a dielectric and of a metal."""
    posterior: tuple[wp.array, wp.array]
    """Lobes of the posterior, of the same two."""


def sampling_tables(responses: wp.array) -> SamplingTables:
    """Return the tables of the search and of the posterior, from response_table. Waits for the device."""
    return SamplingTables(responses, *((search_table(responses, DIELECTRIC, widths), search_table(responses, METAL, widths))
                                       for widths in (SEARCH_WIDTHS, POSTERIOR_WIDTHS)))


class Found(NamedTuple):
    """Normal and material of least cost of each sampled pixel, on the host."""

    normal: np.ndarray  # [n, 3] float32, unit
    other: np.ndarray  # [n, 3] float32, unit: the second-best minimum of the grid
    metallic: np.ndarray  # [n] bool: lobes with the Fresnel rise of a metal explain the pixel better
    weights: np.ndarray  # [n, lobes] float32, of the mixture
    cost: np.ndarray  # [n] float32, per light
    diffuse_albedo: np.ndarray  # [n, 3] float32
    specular: np.ndarray  # [n, 3] float32, F0
    roughness: np.ndarray  # [n] float32


def search_sampling(samples: Samples, tables: SamplingTables, view: np.ndarray, *, start: np.ndarray | None = None) -> Found:
    """Find the normal and the material of sampled pixels that explain their readings best; waits for the device.
    `samples`: their readings, radiance over the irradiance of each light. `view`: [n, 3] unit directions to the viewer. `start`: [n, 3]
    unit normals near which the best ones lie; None: they may be anywhere on the visible hemisphere."""
    lambert = LobeShape()
    first, other = find_modes(samples, bounded(tables.search[0], samples), view) if start is None else (start, start)
    near = search_normals(samples, first, shape=lambert, options=AROUND_OPTIONS, wide=AROUND[0], fine=AROUND[1:],
                          table=tables.search[0]).normal
    searches = [search_normals(samples, near, shape=lambert, options=OPTIONS, wide=FINE[0], fine=FINE[1:], table=table)
                for table in tables.search]
    materials = [fit_material(samples, search.normal, shape=lambert, options=OPTIONS, table=tables.responses) for search in searches]
    metallic = materials[1].cost < materials[0].cost
    material = Material(*either(metallic, *reversed(materials)))
    normal, cost, weights = either(metallic, *((search.normal, search.cost, search.weights) for search in reversed(searches)))
    return Found(normal, other, metallic, weights, cost, *material[:3])


def solve_sampling(samples: Samples, tables: SamplingTables, view: np.ndarray, *, found: Found | None = None) -> SamplingFit:
    """Estimate normal, material and regime of sampled pixels; `found` is what search_sampling found for them, if it was asked."""
    lambert = LobeShape()
    if found is None:
        found = search_sampling(samples, tables, view)
    metallic = found.metallic
    material = Material(*(values.copy() for values in (found.diffuse_albedo, found.specular, found.roughness, found.cost)))
    kinds = [kind for kind in (False, True) if (metallic == kind).any()]
    groups = [Group(choose(samples, metallic == kind), bounded(tables.posterior[kind], samples), found.normal[metallic == kind])
              for kind in kinds]
    noise = measure_noise(groups)
    modes = Modes.empty(samples.pixel_count)
    for kind, group in zip(kinds, groups, strict=True):
        other = search_normals(group.samples, found.other[metallic == kind], shape=lambert, options=AROUND_OPTIONS, wide=AROUND[0],
                               fine=AROUND[1:], table=tables.search[kind]).normal
        put(modes, metallic == kind, weigh(normal_posterior(group, noise), normal_posterior(group._replace(normal=other), noise)))
    kept = modes.close_to(found.normal)
    normal = np.where(kept[:, None], found.normal, modes.normal)
    if not kept.all():
        again = fit_material(choose(samples, ~kept), normal[~kept], shape=lambert, options=OPTIONS, table=tables.responses)
        put(material, ~kept, again)
    facing = (normal * view).sum(axis=1)
    return SamplingFit(normal, material.diffuse_albedo, material.specular, material.roughness,
                       regimes(found.weights, np.where(metallic, METAL, DIELECTRIC), facing, material),
                       modes.spread, np.sqrt(found.cost))


def regimes(weights: np.ndarray, f0: np.ndarray, facing: np.ndarray, material: Material) -> np.ndarray:
    """Return [n] uint8 codes of Regime: a part of the light counts where both the mixture and the material contain it.
    `weights`: [n, lobes] of the mixture. `f0`: [n] of its specular lobes. `facing`: [n] n·v. `material`: of the same pixels."""
    fresnel = f0 + (1 - f0) * np.clip(1 - facing, 0, 1) ** 5
    mixed = SPECULAR_SCALE / f0 * fresnel * weights[:, 1:].sum(axis=1)  # under even light, as π times the diffuse weight is
    mixed /= np.maximum(mixed + np.pi * weights[:, 0], 1e-20)
    plain = material.specular.mean(axis=1)
    plain = plain / np.maximum(plain + material.diffuse_albedo.mean(axis=1), 1e-20)
    specular = np.minimum(mixed, plain) >= LEAST_SPECULAR
    diffuse = np.maximum(mixed, plain) <= 1 - LEAST_DIFFUSE
    pure = np.where(material.roughness < SHARP, Regime.MIRROR, Regime.GLOSSY)
    return np.where(specular, np.where(diffuse, Regime.MIXTURE, pure), Regime.LAMBERTIAN).astype(np.uint8)
