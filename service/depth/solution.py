"""The result of every way of measuring depth: depth, its uncertainty and status at every pixel."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from kernels.status import ESTIMATED, SOLVED, Status
from stage.camera import Camera
from stage.depth_maps import DepthMaps

HALF_SURE = 1e-3
"""Standard deviation of the depth over the depth, at which confidence is one half."""


@dataclass(kw_only=True)
class PixelSolution:
    """What every way of measuring says of each pixel, and of the whole scene."""

    method: str
    """What was decoded, in words for the report."""
    status: np.ndarray  # [rows, cols] uint8
    confidence: np.ndarray | None = None  # [rows, cols] 0…1; None: from sigma
    least_confidence: float = 0.0
    """Least confidence of a pixel that counts as solved, where the request names none."""
    warnings: list[str] = field(default_factory=list)
    """A sentence for each thing that does not fit on the whole scene: what it is, and what to try."""
    facts: dict[str, Any] = field(default_factory=dict)
    """What was found out on the way, for the report."""

    @property
    def solved(self) -> np.ndarray:
        """Return which pixels are solved, [rows, cols] bool."""
        return np.isin(self.status, SOLVED)

    def counts(self, mask: np.ndarray) -> dict[str, int]:
        """Return how many pixels of the mask have each status, by name."""
        return status_counts(self.status, mask)


@dataclass(kw_only=True)
class DepthSolution(PixelSolution):
    """Depth at every pixel of the image; only pixels with a status of kernels.status.ESTIMATED have a depth.

    Projector coordinates are kept where they are decoded, also where triangulation fails.
    """

    depth: np.ndarray  # [rows, cols] float32 metres
    sigma: np.ndarray | None = None  # [rows, cols] float32 metres
    range_m: np.ndarray | None = None  # [rows, cols] float32 metres along the ray
    projector_u: np.ndarray | None = None  # [rows, cols] float32 projector pixels
    projector_v: np.ndarray | None = None  # [rows, cols] float32 projector pixels
    sigma_u: np.ndarray | None = None  # [rows, cols] float32 projector pixels, standard deviation of the decoded column
    sigma_v: np.ndarray | None = None  # [rows, cols] float32 projector pixels, of the decoded row
    amplitude: np.ndarray | None = None  # [rows, cols] float32, in the unit of the images
    colour: np.ndarray | None = None  # [rows, cols, 3] float32 linear, of the scene under even light; None: the amplitude's grey
    points: np.ndarray | None = None  # [n, 3] float32: measured places between pixel centres, in place of a point a pixel
    pixels: np.ndarray | None = None  # [n, 2] int: row and column of each of these, for its colour

    @property
    def estimated(self) -> np.ndarray:
        """Return where there is a value, however unsure, [rows, cols] bool."""
        return np.isin(self.status, ESTIMATED) & (self.depth != 0)

    def confidence_map(self) -> np.ndarray | None:
        """Return confidence 0…1, [rows, cols]: the method's own, or 1 / (1 + σ / (depth / 1000)) from the standard deviation."""
        if self.confidence is not None or self.sigma is None:
            return self.confidence
        relative = self.sigma / np.maximum(self.depth * HALF_SURE, 1e-12)
        return np.where(self.estimated, 1 / (1 + relative), 0).astype(np.float32)

    def statistics(self) -> dict[str, dict[str, float]]:
        """Return the spread of the depth and of its deviation over the solved pixels, for the report."""
        return {"depth_m": statistics(self.depth[self.solved]),
                "sigma_m": statistics(self.sigma[self.solved]) if self.sigma is not None else {}}

    def maps(self, camera: Camera, provenance: dict[str, str]) -> DepthMaps:
        """Return the layers of depth.exr."""
        return DepthMaps(
            camera=camera, mask=self.solved, estimated=self.estimated, depth=self.depth, range=self.range_m,
            projector_u=self.projector_u, projector_v=self.projector_v, amplitude=self.amplitude, sigma=self.sigma,
            sigma_u=self.sigma_u, sigma_v=self.sigma_v, confidence=self.confidence_map(), status=self.status, provenance=provenance)


def status_counts(status: np.ndarray, mask: np.ndarray) -> dict[str, int]:
    """Return how many pixels of the mask have each status, by name."""
    numbers = np.bincount(status[mask], minlength=max(Status) + 1)
    return {code.name.lower(): int(numbers[code]) for code in Status}


def statistics(values: np.ndarray) -> dict[str, float]:
    """Return the median and the 5th and 95th percentile of what was measured, for the report."""
    if values.size == 0:
        return {}
    low, middle, high = np.percentile(values.astype(np.float64), [5, 50, 95])
    return {"p05": float(f"{low:.6g}"), "median": float(f"{middle:.6g}"), "p95": float(f"{high:.6g}")}
