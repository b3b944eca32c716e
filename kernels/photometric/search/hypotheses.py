"""Normals by hypothesis and test: each candidate normal is judged by how well a non-negative mixture of lobes explains the
readings.

For a candidate the readings are expected to be Σ x_k f_k(l), x ≥ 0, with f_0 a diffuse lobe and the others highlights of fixed widths. The
mixture is fitted by re-weighted non-negative least squares with Cauchy weights relative to the noise σ = s0 + s1 · reading, and the
candidate's cost is Σ log(1 + r²/σ²) over the lights. A light that reads far below its prediction is in cast shadow, which has a fixed cost:
any candidate may be shadowed, but no reading may be brighter than the lobes of the candidate. Candidates are rings about the best normal so
far, coarse to fine. Where the readings decide little, a prior may draw candidates to the normal of a simpler method.

Source: hypothesised normals after Hui and Sankaranarayanan, "Shape and spatially-varying reflectance estimation from virtual
exemplars", TPAMI 2017; here with analytic lobes in place of measured materials, and robust.
"""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.device import once
from kernels.errors import ArrayError
from kernels.packs import pack_type
from kernels.photometric.model.candidates import rings
from kernels.photometric.model.lobes import direction_lobes
from kernels.photometric.model.robust_weights import Criteria
from kernels.photometric.model.samples import Samples, host_values, per_pixel, samples_type, scratch_memory, scratch_type, to_host
from kernels.photometric.model.tabulated_lobes import tabulated_lobes
from kernels.photometric.search.search_kernel import REWEIGHTINGS, SWEEPS, search_kernel, search_type


@dataclass(frozen=True, kw_only=True)
class LobeShape:
    """Shape of the lobes, shared by the pixels of a material."""

    rough: float = -1.0
    """Roughness of Burley's diffuse lobe, 0…1; a value below 0 selects Lambert's lobe."""
    slope: float = 0.0
    """Slope s of a further factor 1 + s · (1 - n·l)."""
    short_tails: bool = False
    """Whether highlights fall off nearly as Beckmann's, and not as those of GGX; see microfacet.short_tails."""
    facets: float = 0.0
    """Ratio B/A of Oren and Nayar's lobe of matt facets: .12, .3, .44 and .58 for slopes of 10°, 20°, 30° and 45°."""


@dataclass(frozen=True, kw_only=True)
class SearchOptions:
    """Options for the scores of candidates."""

    noise_floor: float = 0.1
    """Noise s0 of every reading, relative to the pixel's level: it covers the part of a good pixel that the lobes cannot explain."""
    noise_slope: float = 0.02
    """Relative noise s1 of bright readings."""
    shadow_cost: float = 1.0
    """Cost of a reading that counts as cast shadow; 1.0 is the cost of a residual of 1.3 σ."""
    shadow_depth: float = 0.3
    """Fraction of its prediction below which a reading may be a cast shadow."""

    def noise(self, readings: np.ndarray) -> np.ndarray:
        """Return the deviation of readings that is expected, in their unit."""
        return np.asarray(self.noise_floor + self.noise_slope * np.maximum(readings, 0))


@dataclass(frozen=True, kw_only=True)
class RingOptions(SearchOptions):
    """Options for the scores of candidates on rings, and for the fit of the mixture of each."""

    reweightings: int = REWEIGHTINGS
    """Rounds of the robust fit."""
    sweeps: int = SWEEPS
    """Coordinate sweeps of each non-negative solve."""

    @classmethod
    def of(cls, options: SearchOptions, *, reweightings: int = REWEIGHTINGS) -> "RingOptions":
        """Return options that judge alike, with a number of rounds of the robust fit."""
        return cls(noise_floor=options.noise_floor, noise_slope=options.noise_slope, shadow_cost=options.shadow_cost,
                   shadow_depth=options.shadow_depth, reweightings=reweightings)


def criteria(options: SearchOptions | None, shape: LobeShape) -> Criteria:
    """Return what kernels judge readings by; without options, the defaults."""
    options = options or SearchOptions()
    found = Criteria()
    found.noise = wp.vec2(options.noise_floor, options.noise_slope)
    found.shadow = wp.vec2(math.expm1(options.shadow_cost), options.shadow_depth)
    found.form = wp.vec4(shape.rough, shape.slope, float(shape.short_tails), shape.facets)
    return found


PRIOR_DEGREES = 10.0
"""Angle from the normal of a prior at which its cost begins to grow as a logarithm: far candidates that explain the readings stay
possible."""


class Prior(NamedTuple):
    """Normals that are expected before the readings are judged."""

    normal: np.ndarray  # [n, 3] float32, unit
    strength: float
    """A candidate at angle a from the normal costs strength · log(1 + (a / PRIOR_DEGREES)²) more, on the sum over the lights."""


def prior_pull(prior: Prior | None) -> Any:
    """Return the strength of a prior and 1 / rad² of its angle, as the kernels take them; the strength is 0 where there is none."""
    return wp.vec2(0.0 if prior is None else prior.strength, 1.0 / math.radians(PRIOR_DEGREES) ** 2)


class Search(NamedTuple):
    """Best candidate of each sampled pixel."""

    normal: np.ndarray  # [n, 3] float32, unit
    cost: np.ndarray  # [n] float32, per light
    weights: np.ndarray  # [n, lobes] float32, of the mixture, for readings relative to the pixel's level
    survey: wp.array  # [candidates, packs] float packs, on the device: cost of each candidate of the first rings, summed over the lights


def search_normals(samples: Samples, start: np.ndarray, *, shape: LobeShape,
                   wide: tuple[tuple[float, ...], int],
                   fine: tuple[tuple[tuple[float, ...], int], ...] = (), options: RingOptions | None = None,
                   table: wp.array | None = None, prior: Prior | None = None) -> Search:
    """Find the candidate normal of least cost for each sampled pixel; waits for the device.

    Args:
        start: [n, 3] unit normals to begin from.
        wide: radii of the first rings, about the start, in degrees, and the number of candidates on the last of them.
        fine: the same of the rings that follow, each about the best candidate so far.
        options: how candidates are judged.
        table: [cells, lights, lobes] of response_table.search_table or of a reference ball, in place of the samples' directions;
            its diffuse lobe is what it is, whatever the shape.
        prior: normals that candidates are drawn to, of which the costs include the cost; None: none.
    """
    options = options or RingOptions()
    if start.shape != (samples.pixel_count, 3):
        raise ArrayError(f"start is {start.shape}: give one normal for each of the {samples.pixel_count} pixels")
    if table is not None and table.shape[1] != samples.light_count:
        raise ArrayError(f"table has {table.shape[1]} lights, the samples {samples.light_count}: tabulate those of the samples")
    device, lanes, packs = samples.device, samples.lanes, samples.packs
    lane_type = pack_type(lanes, wp.float32)
    found = search_type(lanes)()
    found.normal, found.cost = per_pixel(samples, start), wp.empty(packs, dtype=lane_type, device=device)
    drawn = per_pixel(samples, start if prior is None else prior.normal)
    lobes = direction_lobes(lanes) if table is None else tabulated_lobes(lanes, table.shape[2])
    found.weights = wp.empty((lobes.count, packs), dtype=lane_type, device=device)
    table = wp.empty((0, 0, 0), dtype=wp.float32, device=device) if table is None else table
    scratch = scratch_memory(samples, lobes.held)
    survey = None
    for degrees, count in (wide, *fine):
        offsets = wp.array(rings(degrees, count), dtype=wp.vec4, device=device)
        found.costs = wp.empty((offsets.shape[0], packs), dtype=lane_type, device=device)
        survey = found.costs if survey is None else survey
        radius = math.sin(math.radians(degrees[0])) if len(degrees) == 1 else 0.0
        devices.launch(search_kernel(lanes, lobes, options.reweightings, options.sweeps), packs,
                       [samples.arrays, table, offsets, radius, drawn, prior_pull(prior), criteria(options, shape)], [scratch, found],
                       device=device, uneven=True)
    return Search(*(to_host(samples, values) for values in (found.normal, found.cost, found.weights)), survey)


def predict(samples: Samples, normal: np.ndarray, weights: np.ndarray, *, shape: LobeShape) -> np.ndarray:
    """Return the readings, [n, lights] float32, that mixtures of lobes predict relative to the level of each pixel; waits for the device.

    `weights` is [n, lobes] of the mixtures, from search_normals.
    """
    predicted = wp.empty_like(samples.grey)
    devices.launch(_predict_kernel(samples.lanes), samples.packs,
                   [samples.arrays, wp.empty((0, 0, 0), dtype=wp.float32, device=samples.device), per_pixel(samples, normal),
                    per_pixel(samples, weights), criteria(None, shape)],
                   [scratch_memory(samples, direction_lobes(samples.lanes).held), predicted], device=samples.device)
    return host_values(samples, predicted)


@once
def _predict_kernel(lanes: int) -> Any:
    lane_type, samples_struct, scratch_struct = pack_type(lanes, wp.float32), samples_type(lanes), scratch_type(lanes)
    mixture, _, _, prepare, fill = direction_lobes(lanes)

    @wp.kernel(enable_backward=False, module="unique", module_options={"max_unroll": 0})
    def predict_kernel(first: int,
                       samples: samples_struct,
                       table: wp.array3d(dtype=float),  # of no use to lights of one direction
                       normal: wp.array2d(dtype=lane_type),  # [3, P]
                       weights: wp.array2d(dtype=lane_type),  # [lobes, P]
                       criteria: Criteria,
                       # outputs
                       scratch: scratch_struct,  # what the lobes hold
                       predicted: wp.array(dtype=lane_type)):  # [P · L]
        p = first + wp.tid()
        prepare(samples, p, scratch)
        fill(samples, table, criteria.form, normal[0, p], normal[1, p], normal[2, p], p, scratch)
        for light in range(samples.light_count):
            total = lane_type()
            for a in range(mixture):
                f = scratch.values[p * scratch.pack_stride + light * scratch.light_stride + a * scratch.step]
                x = weights[a, p]
                for k in range(lanes):
                    total[k] += f[k] * x[k]
            predicted[p * samples.pack_stride + light * samples.light_stride] = total

    return predict_kernel
