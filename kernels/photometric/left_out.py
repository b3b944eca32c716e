"""Whether few lights support the general solver: readings of lights that are left out are predicted by it and by Lambert's law.

A mixture of six lobes and a normal follow a dozen readings whatever their cause, be it a highlight or a light whose direction is a few
degrees off. What they learnt from highlights predicts further readings; what they learnt from errors does not.

Source: choice of a model by the prediction of left-out data, Stone, "Cross-validatory choice and assessment of statistical predictions",
Journal of the Royal Statistical Society B 1974.
"""

from functools import cache
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.packs import pack_type
from kernels.photometric.hypotheses import Diffuse, SearchOptions, criteria, search_normals
from kernels.photometric.lobes import direction_lobes
from kernels.photometric.samples import Samples, per_pixel

PARTS = 12
"""Number of parts into which the lights are divided, each left out once; fewer lights are left out singly."""
RIDGE = 1e-6
"""Added to the diagonal of the normal equations, so that coplanar lights give a solution."""


class LeftOut(NamedTuple):
    """Mean cost of the left-out readings, as the search counts it."""

    general: float
    """As the mixture of lobes predicts them."""
    lambert: float
    """As Lambert's law predicts them."""

    @property
    def ratio(self) -> float:
        """Cost of the general prediction over that of Lambert's law."""
        return self.general / max(self.lambert, 1e-9)


def leave_out(samples: Samples, start: np.ndarray, *, options: SearchOptions | None = None) -> LeftOut:
    """Predict the readings of each light from those of the others.

    Args:
        samples: some hundreds of pixels, spread over the object, under four lights or more.
        start: [n, 3] unit normals to begin from.
        options: how readings are judged.

    Returns:
        Costs of both predictions. Waits for the device.
    """
    options = options or SearchOptions()
    lights = samples.light_count
    readings = _host(samples, samples.grey).astype(np.float64)
    toward = np.stack([_host(samples, samples.toward[axis]) for axis in range(3)], axis=-1).astype(np.float64)
    parts = min(PARTS, lights)
    costs: tuple[list[np.ndarray], list[np.ndarray]] = ([], [])
    for part in range(parts):
        out = np.arange(lights) % parts == part
        kept = np.where(out, -1.0, readings)
        lambertian = _lambert(kept, toward)
        rest = samples._replace(grey=_device(samples, kept))
        found = search_normals(rest, start, shape=Diffuse(), options=options)
        general = _predict(samples, found.normal, found.weights)
        given = readings[:, out] >= 0
        for kept_costs, predicted in zip(costs, (general, np.einsum("nlc,nc->nl", toward, lambertian)), strict=True):
            kept_costs.append(_cost(readings[:, out], np.maximum(predicted[:, out], 0), options)[given])
    return LeftOut(*(float(np.concatenate(each).mean()) if sum(map(len, each)) else 0.0 for each in costs))


def _lambert(readings: np.ndarray, toward: np.ndarray) -> np.ndarray:
    """Return [n, 3] the least-squares b of b·l = reading over the readings above zero."""
    weights = (readings > 0).astype(np.float64)
    gram = np.einsum("nl,nli,nlj->nij", weights, toward, toward) + RIDGE * np.eye(3)
    return np.linalg.solve(gram, np.einsum("nl,nli->ni", weights * readings, toward)[..., None])[..., 0]


def _cost(readings: np.ndarray, predicted: np.ndarray, options: SearchOptions) -> np.ndarray:
    """Return the cost of each reading as the search counts it."""
    squared = ((readings - predicted) / (options.noise_floor + options.noise_slope * np.maximum(readings, 0))) ** 2
    dark = (readings < options.shadow_depth * predicted) & (squared > np.expm1(options.shadow_cost))
    return np.where(dark, options.shadow_cost, np.log1p(squared))


def _host(samples: Samples, packs: wp.array) -> np.ndarray:
    """Return [packs · lights] packs as [n, lights] host values."""
    values = packs.numpy()
    if samples.light_stride == 1:
        flat = values.reshape(samples.packs, samples.light_count, samples.lanes).transpose(0, 2, 1)
    else:
        flat = values.reshape(samples.light_count, samples.packs, samples.lanes).transpose(1, 2, 0)
    return flat.reshape(-1, samples.light_count)[: samples.pixel_count]


def _device(samples: Samples, values: np.ndarray) -> wp.array:
    """Return [n, lights] host values as [packs · lights] packs."""
    order = np.minimum(np.arange(samples.packs * samples.lanes), samples.pixel_count - 1)
    planes = values[order].astype(np.float32).reshape(samples.packs, samples.lanes, samples.light_count)
    planes = planes.transpose(0, 2, 1) if samples.light_stride == 1 else planes.transpose(2, 0, 1)
    return wp.array(np.ascontiguousarray(planes).reshape(-1, samples.lanes), dtype=samples.grey.dtype, device=samples.device)


def _predict(samples: Samples, normal: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return [n, lights] the readings that a mixture under a normal predicts, relative to the pixel's level."""
    lanes, packs, lights = samples.lanes, samples.packs, samples.light_count
    lobes = direction_lobes(lanes)
    lane_type = pack_type(lanes, wp.float32)
    predicted = wp.empty(packs * lights, dtype=lane_type, device=samples.device)
    scratch = wp.empty(packs * lights * lobes.held, dtype=lane_type, device=samples.device)
    devices.launch(_predict_kernel(lanes), packs,
                   [samples.toward, wp.empty((0, 0, 0), dtype=wp.float32, device=samples.device), samples.view,
                    per_pixel(samples, normal), per_pixel(samples, weights), criteria(SearchOptions(), Diffuse())[2], lights,
                    samples.pack_stride, samples.light_stride],
                   [scratch, predicted], device=samples.device)
    return _host(samples, predicted)


@cache
def _predict_kernel(lanes: int) -> Any:
    lane_type = pack_type(lanes, wp.float32)
    mixture, held, _, prepare, fill = direction_lobes(lanes)

    @wp.kernel(enable_backward=False, module="unique", module_options={"max_unroll": 0})
    def predict_kernel(first: int,
                       toward: wp.array2d(dtype=lane_type),  # [3, P · L]
                       table: wp.array3d(dtype=float),  # of no use to lights of one direction
                       view: wp.array2d(dtype=lane_type),  # [3, P]
                       normal: wp.array2d(dtype=lane_type),  # [3, P]
                       weights: wp.array2d(dtype=lane_type),  # [lobes, P]
                       form: wp.vec2,  # diffuse roughness, slope
                       light_count: int,
                       pack_stride: int,
                       light_stride: int,
                       # outputs
                       scratch: wp.array(dtype=lane_type),  # [P · L · held]
                       predicted: wp.array(dtype=lane_type)):  # [P · L]
        p = first + wp.tid()
        start, base = p * pack_stride, p * light_count * held
        prepare(toward, view[0, p], view[1, p], view[2, p], start, light_count, light_stride, base, 1, scratch)
        fill(toward, table, form, normal[0, p], normal[1, p], normal[2, p], view[0, p], view[1, p], view[2, p],
             start, light_count, light_stride, base, 1, scratch)
        for light in range(light_count):
            total = lane_type()
            for a in range(mixture):
                f, x = scratch[base + light * held + a], weights[a, p]
                for k in range(lanes):
                    total[k] += f[k] * x[k]
            predicted[start + light * light_stride] = total

    return predict_kernel
