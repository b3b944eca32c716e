"""The fitted specular workflow as the metallic one: base colour, metallic and index of refraction of diffuse albedo and F0.

Clients agree on the metallic workflow alone: Blender and three.js multiply `specularColor` with the F0 of the index of refraction, which
makes every metal black. A metallic surface of base colour c, metallic m and index of refraction n has

    diffuse albedo = c (1 - m),    F0 = d (1 - m) + c m,    d = ((n - 1) / (n + 1))²,

which Blender, three.js, glTF and OpenPBR mix alike (Storm tints d by the base colour where 0 < m < 1). F90 is 1 for dielectrics and metals
in Blender, three.js, glTF and OpenPBR, as in Relit's BRDF; the base colour for metals in Storm.

Source: OpenUSD, "UsdPreviewSurface Specification", inputs metallic and ior; glTF 2.0, appendix B.2 (metal-roughness material).
"""

import json
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np

from stage.results.maps import SurfaceMaps

GLASS_IOR = 1.5
"""The usual index of refraction of dielectrics and the default of every client: F0 is 0.04."""

IOR_LIMITS = (1.0, 2.5)
"""Nothing reflects less than n = 1; no common dielectric reflects more than diamond, 2.4."""

MIRROR = 3
"""Code of a mirror in the layer `regime`: specular light alone."""

SPREAD_PERCENTILES = (16, 84)
"""Percentiles of F0 between which the F0 of glass is taken as the true one: one standard deviation about the median of normal noise."""

HALF_ROUNDING = 2.0**-11
"""Relative rounding of the layers of maps.exr, which store F0 as half."""

LEAST_DIELECTRIC_PIXELS = 16
"""Below it the median of F0 is one of noise, and dielectrics are taken as glass."""

GRID, GOLDEN_STEPS = 9, 10
"""Values of metallic of the first search, and steps of the second about the best of them: 2/8 · 0.618¹⁰ is 0.002, of which the misfit is
10⁻⁶; on random colours the least of 2001 values is never more than 10⁻⁴ better, as a squared reflectance."""

EXACT = 1e-6
"""Squared misfit of a pixel that single precision cannot tell from none: the nearer end, 0 or 1, is taken then."""

LOSS_MATTERS = 0.03
"""RMS loss of reflectance that is worth a warning: a tenth of what an average object reflects."""

BAND_PIXELS = 1 << 15
"""Pixels of a band: its planes of 128 KiB stay in the cache of a core."""


class MetallicLook(NamedTuple):
    """The metallic workflow of solved maps."""

    base_color: np.ndarray  # [rows, cols, 3] float32, scene-linear in the colour space of the maps; 0 where not known
    metallic: np.ndarray  # [rows, cols] float32, 0…1; 0 where not known
    known: np.ndarray  # [rows, cols] bool, pixels of the mask whose layers are finite
    ior: float  # of the dielectric share of all pixels, IOR_LIMITS; 1 without specular light
    lost_albedo: float  # RMS of the difference in diffuse albedo from the maps, over the mask and three channels
    lost_specular: float  # the same of F0

    @property
    def provenance(self) -> dict[str, str]:
        """Return the values that were derived from the maps, for the metadata of an asset."""
        derived = {"ior": self.ior, "lost_albedo": self.lost_albedo, "lost_specular": self.lost_specular}
        return {"relit:metallic": json.dumps({name: round(value, 6) for name, value in derived.items()})}


def metallic_look(maps: SurfaceMaps) -> MetallicLook:
    """Return base colour and metallic of each pixel, and one index of refraction, that reflect most like the maps.

    A pixel has six numbers, the metallic workflow four: what does not fit is divided between albedo and F0 by least squares. A pixel that
    reflects less than the index of refraction says, or a dielectric with coloured F0, loses that; blends of a metal and a dielectric lose
    nothing if their colours are alike. `maps`: with `diffuse_albedo`. Without `specular` the surface is Lambertian: the albedo is the base
    colour, metallic is 0, and nothing is reflected at n = 1."""
    assert maps.diffuse_albedo is not None, "maps without reflectance have no look"
    base_color = np.zeros((*maps.mask.shape, 3), dtype=np.float32)
    metallic = np.zeros(maps.mask.shape, dtype=np.float32)
    finite = maps.mask & np.isfinite(maps.diffuse_albedo.sum(axis=-1))
    if maps.specular is None:
        np.copyto(base_color, maps.diffuse_albedo, where=finite[..., None])
        return MetallicLook(base_color, metallic, finite, IOR_LIMITS[0], 0.0, 0.0)
    finite &= np.isfinite(maps.specular.sum(axis=-1))
    ior = dielectric_ior(maps.specular[finite])
    dielectric = specular_of_ior(ior)
    diffuse_albedo, specular = maps.diffuse_albedo, maps.specular

    def convert_band(rows: slice) -> tuple[float, float, int]:
        known = finite[rows]
        albedo, f0 = (np.ascontiguousarray(layer[rows][known].T, dtype=np.float32) for layer in (diffuse_albedo, specular))
        share = _metal_share(albedo, f0, dielectric)
        if maps.regime is not None:
            share[maps.regime[rows][known] == MIRROR] = 1
        colour = _base_color(share, albedo, f0, dielectric)
        base_color[rows][known], metallic[rows][known] = colour.T, share
        lost_albedo, lost_f0 = _residuals(share, colour, albedo, f0, dielectric)
        return float((lost_albedo**2).sum()), float((lost_f0**2).sum()), len(share)

    band = max(1, BAND_PIXELS // maps.mask.shape[1])
    bands = [slice(start, start + band) for start in range(0, maps.mask.shape[0], band)]
    with ThreadPoolExecutor(os.cpu_count(), thread_name_prefix="relit-metallic") as pool:
        sums = list(pool.map(convert_band, bands))
    lost_albedo, lost_f0, count = (sum(column) for column in zip(*sums, strict=True))
    return MetallicLook(base_color, metallic, finite, ior, _rms(lost_albedo, int(count)), _rms(lost_f0, int(count)))


def loss_warnings(look: MetallicLook) -> Iterator[str]:
    """Yield what the metallic workflow loses of the maps, where that is visible."""
    if max(look.lost_albedo, look.lost_specular) > LOSS_MATTERS:
        yield (f"material: base colour and metallic miss F0 by {look.lost_specular:.2f} and the diffuse albedo by {look.lost_albedo:.2f} "
               "(RMS): they have one colour a pixel and one index of refraction; the look specular of a USD asset has what was fitted")


def specular_of_ior(ior: float) -> float:
    """Return F0 of a dielectric of this index of refraction in air."""
    return ((ior - 1) / (ior + 1)) ** 2


def dielectric_ior(specular: np.ndarray) -> float:
    """Return one index of refraction of the pixels that are dielectrics: of the median of their F0 [n, 3], or that of glass.

    Pixels with a channel above the F0 of IOR_LIMITS are taken as metal, or as a blend with it. GLASS_IOR is returned where its F0 lies in
    the spread of the pixels, and where there are no dielectrics.
    """
    strongest = specular.max(axis=-1)
    f0 = specular.mean(axis=-1, dtype=np.float32)[strongest <= specular_of_ior(IOR_LIMITS[1])]
    if len(f0) < LEAST_DIELECTRIC_PIXELS:
        return GLASS_IOR
    low, middle, high = np.percentile(f0, (SPREAD_PERCENTILES[0], 50, SPREAD_PERCENTILES[1]))
    if low * (1 - HALF_ROUNDING) <= specular_of_ior(GLASS_IOR) <= high * (1 + HALF_ROUNDING):
        return GLASS_IOR
    root = float(np.sqrt(max(middle, 0.0)))
    return float(np.clip((1 + root) / (1 - root), *IOR_LIMITS))


def _metal_share(albedo: np.ndarray, f0: np.ndarray, dielectric: float) -> np.ndarray:
    """Return metallic [n] of least misfit of pixels with albedo and F0 [3, n].

    The best unbounded base colour at m leaves, summed over the channels, ((1 - m) (F0 - d (1 - m)) - m ρ)² / ((1 - m)² + m²): a quartic
    over a quadratic, searched first. Where the base colour it needs is not in 0…1, the misfit of the bounded one is searched.
    """
    offset, slope = f0 - dielectric, 2 * dielectric - f0 - albedo  # (1 - m)(F0 - d (1 - m)) - m ρ = offset + slope m - d m²
    c0, c1, c2 = (offset**2).sum(0), 2 * (offset * slope).sum(0), (slope**2).sum(0) - 2 * dielectric * offset.sum(0)
    c3, c4 = -2 * dielectric * slope.sum(0), 3 * dielectric**2

    def unbounded(m: np.ndarray | float) -> np.ndarray:
        return ((((c4 * m + c3) * m + c2) * m + c1) * m + c0) / (1 - 2 * m * (1 - m))

    share = _least(unbounded, albedo.shape[1])
    needed = _base_color(share, albedo, f0, dielectric, bounded=False)
    outside = ((needed < 0) | (needed > 1)).any(axis=0)
    if outside.any():
        some_albedo, some_f0 = albedo[:, outside], f0[:, outside]

        def bounded(m: np.ndarray | float) -> np.ndarray:
            colour = _base_color(m, some_albedo, some_f0, dielectric)
            return sum((residual**2).sum(axis=0) for residual in _residuals(m, colour, some_albedo, some_f0, dielectric))

        share[outside] = _least(bounded, some_albedo.shape[1])
    return share


def _base_color(m: np.ndarray | float, albedo: np.ndarray, f0: np.ndarray, dielectric: float, *, bounded: bool = True) -> np.ndarray:
    """Return the base colour [3, n] of least misfit at metallic m [n], within 0…1 if bounded."""
    colour = ((1 - m) * albedo + m * (f0 - dielectric * (1 - m))) / (1 - 2 * m * (1 - m))
    return np.clip(colour, 0, 1, out=colour) if bounded else colour


def _residuals(m: np.ndarray | float, colour: np.ndarray, albedo: np.ndarray, f0: np.ndarray,
               dielectric: float) -> tuple[np.ndarray, np.ndarray]:
    """Return what a metallic surface has more than albedo and F0 [3, n] of the maps."""
    return colour * (1 - m) - albedo, dielectric * (1 - m) + colour * m - f0


def _least(misfit: Callable[[np.ndarray | float], np.ndarray], count: int) -> np.ndarray:
    """Return where in 0…1 the misfit of each of `count` pixels is least: a grid, then golden sections about its best point."""
    at_zero, at_one = misfit(0.0), misfit(1.0)
    best, least = np.zeros(count, np.float32), at_zero.copy()
    for index in range(1, GRID):
        value = index / (GRID - 1)
        found = misfit(value) if value < 1 else at_one
        best[found < least] = value
        np.minimum(found, least, out=least)
    golden, half = np.float32((5**0.5 - 1) / 2), np.float32(1 / (GRID - 1))
    low, high = np.maximum(best - half, 0), np.minimum(best + half, 1)
    left, right = high - golden * (high - low), low + golden * (high - low)
    at_left, at_right = misfit(left), misfit(right)
    for _ in range(GOLDEN_STEPS):
        lower = at_left < at_right
        low, high = np.where(lower, low, left), np.where(lower, right, high)
        probe = np.where(lower, high - golden * (high - low), low + golden * (high - low))
        found = misfit(probe)
        left, right = np.where(lower, probe, right), np.where(lower, left, probe)
        at_left, at_right = np.where(lower, found, at_right), np.where(lower, at_left, found)
    best = np.where(at_left < at_right, left, right)
    least = np.minimum(at_left, at_right)
    best[at_one <= least + EXACT] = 1
    best[at_zero <= least + EXACT] = 0
    return best


def _rms(square_sum: float, pixels: int) -> float:
    return (square_sum / max(3 * pixels, 1)) ** 0.5
