"""Normals and lobes of brushed surfaces, whose highlights are streaks: brushed and turned metal, satin.

The microfacets of such a surface spread further across its scratches than along them, so a round lobe explains its streaks only by a normal
that is off, by 10 to 50 degrees. Here a lobe of two widths is fitted with the normal and the direction of the scratches.

Source: that the readings under many lights tell normal and tangent, Holroyd, Lawrence, Humphreys and Zickler, "A photometric approach for
estimating normals and tangents", SIGGRAPH Asia 2008; the lobe and the steps are those of `brushed_kernel`.
"""

from typing import NamedTuple

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.device import to_numpy
from kernels.errors import ArrayError
from kernels.photometric.material.brushed_kernel import START, Readings, brushed_kernel
from kernels.photometric.model.misfit import LARGEST_ERROR
from kernels.photometric.model.samples import Samples, host_vectors, readings_of, to_host
from kernels.photometric.search.hypotheses import LobeShape, criteria

LEAST_LEVEL = 0.1
"""Least level of a pixel's readings over the brightest of them: where a streak falls on a few lights, the others tell the noise alone."""


class Brushed(NamedTuple):
    """The lobe of each sampled pixel."""

    normal: np.ndarray  # [n, 3] float32, unit
    tangent: np.ndarray  # [n, 3] float32, unit, perpendicular to the normal
    widths: np.ndarray  # [n, 2] float32, α along the tangent and across it
    cost: np.ndarray  # [n] float32, per light, of the grey readings
    sigma: np.ndarray  # [n] float32, standard deviation of the normal by the curvature of the cost and the misfit, degrees
    diffuse_albedo: np.ndarray  # [n, 3] float32
    specular: np.ndarray  # [n, 3] float32, F0
    albedo_sigma: np.ndarray  # [n] float32, standard deviation of the grey albedo by the same

    @classmethod
    def unknown(cls, count: int) -> "Brushed":
        """Return lobes of pixels of which none is fitted: their costs are infinite."""
        def zeros(*shape: int) -> np.ndarray:
            return np.zeros((count, *shape), np.float32)

        return cls(zeros(3), zeros(3), zeros(2), np.full(count, np.inf, np.float32), zeros(), zeros(3), zeros(3), zeros())

    @property
    def starts(self) -> np.ndarray:
        """The lobes as starts of another fit, [n, START] float32."""
        return np.concatenate([self.normal, self.tangent, self.widths], axis=1)


def fit_brushed(samples: Samples, starts: np.ndarray, *, shape: LobeShape, round_lobe: bool = False) -> Brushed:
    """Fit normal, lobe and albedo of sampled pixels under lights of one direction each; waits for the device.

    The best start by weighted least squares, and the best one with another normal, are followed, and the better end is kept.

    Args:
        samples: their readings.
        starts: [starts, 1 or n, START] lobes to begin from: the same for all pixels, or those of each.
        shape: of the diffuse lobe.
        round_lobe: whether both widths stay alike, as those of the starts must be then: what a lobe that is not brushed explains.

    Raises:
        ArrayError: no start, or starts for other pixels.
    """
    count, lights = samples.pixel_count, samples.light_count
    if starts.ndim != 3 or not len(starts) or starts.shape[1] not in (1, count) or starts.shape[2] != START:
        raise ArrayError(f"starts are {starts.shape}: give one or more of {START} values, for all or each of {count} pixels")
    device = samples.device

    def put(values: np.ndarray) -> wp.array:
        return wp.array(np.ascontiguousarray(values, dtype=np.float32), dtype=wp.float32, device=device)

    readings = Readings()
    readings.colour = put(np.moveaxis(host_vectors(samples, samples.colour), 1, 2))
    readings.toward = put(np.moveaxis(host_vectors(samples, samples.toward), 1, 2))
    grey = readings_of(samples)
    level = np.maximum(to_host(samples, samples.level), LEAST_LEVEL * grey.max(axis=1))
    readings.grey, readings.level, readings.view = put(grey.T), put(level), put(to_host(samples, samples.view).T)
    fitted = wp.empty((START + 9, count), dtype=wp.float32, device=device)
    devices.launch(brushed_kernel, count,
                   [readings, put(np.moveaxis(starts, 1, 2)), criteria(None, shape), int(round_lobe)], [fitted], device=device, uneven=True)
    values = to_numpy(fitted).T
    tilt, albedo = np.sqrt(np.maximum(values[:, START + 7:], 0)).T
    return Brushed(values[:, :3], values[:, 3:6], values[:, 6:8], values[:, START] / lights, np.minimum(np.degrees(tilt), LARGEST_ERROR),
                   values[:, START + 1:START + 4], values[:, START + 4:START + 7], albedo)
