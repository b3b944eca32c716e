"""Photometric sampling: normal, material and regime of pixels under lights of any extent, mirrors included.

The search of `hypotheses` with its lobes looked up in a response table. It begins with a grid over the whole visible hemisphere,
because a mirror has no Lambertian start, and ends with rings about the best, once under lobes with the Fresnel rise of a
dielectric and once under those of a metal; a pixel keeps the kind whose normal lets Relit's BRDF explain it better.
The mixture and the material found say which regime the pixel is in.

Source: Nayar, Ikeuchi and Kanade, "Determining shape and reflectance of hybrid surfaces by photometric sampling", IEEE
Transactions on Robotics and Automation 1990; here with GGX lobes beside the Lambertian and the mirror one, and a robust
non-negative mixture of them.
"""

from dataclasses import replace
from enum import IntEnum
from typing import NamedTuple

import numpy as np
import warp as wp

from kernels.photometric.hypotheses import Diffuse, Search, SearchOptions, search_normals
from kernels.photometric.material import Material, fit_material
from kernels.photometric.response_table import SPECULAR_SCALE, search_table
from kernels.photometric.samples import Samples

DIELECTRIC, METAL = 0.04, 0.8
"""F0 of the two kinds of lobes. Their Fresnel rises differ, and over a wide light this moves the estimated normal by degrees."""
OPTIONS = SearchOptions(noise_floor=0.05, noise_slope=0.05, sweeps=30)
"""Search options for wide lights. They cause no isolated highlights, so that a dim reading has less unexplained light than under single
lamps; for bright readings the table is accurate to a few per cent."""
HEMISPHERE, HEMISPHERE_OPTIONS = ((tuple(float(d) for d in range(7, 90, 7)), 52),), replace(
    OPTIONS, noise_floor=0.1, noise_slope=0.6, reweightings=2, sweeps=12)
"""Rings and options of the first search, a grid of candidates over the visible hemisphere, 7° apart. The noise assumed is as wide as the
grid's steps: readings of a mirror change by half from one candidate to the next, and a narrower cost would miss the minimum between
them."""
AROUND, AROUND_OPTIONS = (((2.0, 4.0, 6.0), 16), ((1.0, 2.0), 8)), replace(
    OPTIONS, noise_floor=0.1, noise_slope=0.3, reweightings=2, sweeps=12)
"""Rings and options of the second search, about the best candidate of the first."""
FINE = (((1.2, 2.4, 4.0), 14), ((0.6,), 6), ((0.3,), 6), ((0.15,), 6))
"""Rings, in degrees, of the last search, which each kind of lobes makes about the best candidate."""
RING_DEGREES = FINE[-1][0][-1]
"""Radius of the last ring, degrees; the rise of the cost towards it gives the standard error."""
LEAST_DIFFUSE, LEAST_SPECULAR = 0.1, 0.05
"""Least share of the reflected light that a diffuse and a specular part must have to be counted in the regime: plastic of albedo 0.5 has
0.07 specular."""
SHARP = 0.2
"""Roughness below which a specular pixel is called a mirror: its lobe is less than 5° wide, which an extended light cannot resolve."""


class Regime(IntEnum):
    """How a pixel reflects."""

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
    confidence: np.ndarray  # [n] float32: 1 / (1 + standard error of the normal / 1°)
    residual: np.ndarray  # [n] float32: root of the mean cost per light, in units of the noise


class SamplingTables(NamedTuple):
    """Tables of one set of lights."""

    responses: wp.array
    dielectric: wp.array
    metal: wp.array


def sampling_tables(responses: wp.array) -> SamplingTables:
    """Return the tables of the search, from response_table. Waits for the device."""
    return SamplingTables(responses, search_table(responses, DIELECTRIC), search_table(responses, METAL))


def solve_sampling(samples: Samples, tables: SamplingTables, view: np.ndarray, *,
                   options: SearchOptions = OPTIONS) -> SamplingFit:
    """Estimate normal, material and regime of sampled pixels.

    Args:
        samples: their readings, radiance over the irradiance of each light.
        tables: of the same lights.
        view: [n, 3] unit directions to the viewer.
        options: how candidates are judged in the end.

    Returns:
        The fit. Waits for the device.

    Raises:
        ArrayError: shapes that do not fit.
    """
    lambert = Diffuse()
    start = view
    for rings, loose in ((HEMISPHERE, HEMISPHERE_OPTIONS), (AROUND, AROUND_OPTIONS)):
        start = search_normals(samples, start, shape=lambert, options=loose, wide=rings[0], fine=rings[1:],
                               table=tables.dielectric).normal
    searches = [search_normals(samples, start, shape=lambert, options=options, wide=FINE[0], fine=FINE[1:], table=table)
                for table in (tables.dielectric, tables.metal)]
    materials = [fit_material(samples, search.normal, shape=lambert, options=options, table=tables.responses)
                 for search in searches]
    metallic = materials[1].cost < materials[0].cost
    found, material = Search(*_choose(metallic, *searches)), Material(*_choose(metallic, *materials))
    facing = (found.normal * view).sum(axis=1)
    variance = found.variance(samples.light_count, RING_DEGREES)
    return SamplingFit(found.normal, material.diffuse_albedo, material.specular, material.roughness,
                       regimes(found.weights, np.where(metallic, METAL, DIELECTRIC), facing, material),
                       (1 / (1 + np.sqrt(variance))).astype(np.float32), np.sqrt(found.cost))


def _choose(second: np.ndarray, a: tuple[np.ndarray, ...], b: tuple[np.ndarray, ...]) -> list[np.ndarray]:
    """Return the second of two results, field by field, where it is better, else the first."""
    return [np.where(second if x.ndim == 1 else second[:, None], y, x) for x, y in zip(a, b, strict=True)]


def regimes(weights: np.ndarray, f0: np.ndarray, facing: np.ndarray, material: Material) -> np.ndarray:
    """Return the regime of each pixel: a part of the light counts where both the mixture and the material contain it.

    Args:
        weights: [n, lobes] of the mixture.
        f0: [n] of its specular lobes.
        facing: [n] n·v.
        material: of the same pixels.

    Returns:
        [n] uint8 codes of Regime.
    """
    fresnel = f0 + (1 - f0) * np.clip(1 - facing, 0, 1) ** 5
    mixed = SPECULAR_SCALE / f0 * fresnel * weights[:, 1:].sum(axis=1)  # under even light, as π times the diffuse weight is
    mixed /= np.maximum(mixed + np.pi * weights[:, 0], 1e-20)
    plain = material.specular.mean(axis=1)
    plain = plain / np.maximum(plain + material.diffuse_albedo.mean(axis=1), 1e-20)
    specular = np.minimum(mixed, plain) >= LEAST_SPECULAR
    diffuse = np.maximum(mixed, plain) <= 1 - LEAST_DIFFUSE
    pure = np.where(material.roughness < SHARP, Regime.MIRROR, Regime.GLOSSY)
    return np.where(specular, np.where(diffuse, Regime.MIXTURE, pure), Regime.LAMBERTIAN).astype(np.uint8)
