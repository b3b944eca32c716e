"""The result of every way of measuring depth: depth, its uncertainty and status at every pixel."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from kernels.status import ESTIMATED, SOLVED, Status
from stage.capture.camera import Camera
from stage.colour.colour import convert
from stage.colour.colour_spaces import linear_space
from stage.formats.ply import PointCloud
from stage.results.depth_maps import DepthMaps
from stage.results.depth_normals import depth_normals

HALF_SURE = 1e-3
"""Standard deviation of the depth over the depth, at which confidence is one half."""


@dataclass(kw_only=True)
class PixelSolution:
    """The findings that every way of measuring has of each pixel, and of the whole scene."""

    method: str
    """The code or the kind of frames that was decoded, in words for the report."""
    status: np.ndarray  # [rows, cols] uint8
    confidence: np.ndarray | None = None  # [rows, cols] 0…1; None: from sigma
    least_confidence: float = 0.0
    """Least confidence of a pixel that counts as solved, where the request names none."""
    warnings: list[str] = field(default_factory=list)
    """A sentence for each thing that does not fit on the whole scene: what it is, and what to try."""
    facts: dict[str, Any] = field(default_factory=dict)
    """Facts that were found out on the way, for the report."""

    @property
    def solved(self) -> np.ndarray:
        """Return which pixels are solved, [rows, cols] bool."""
        return np.isin(self.status, SOLVED)

    def counts(self, mask: np.ndarray) -> dict[str, int]:
        """Return how many pixels of the mask have each status, by name."""
        numbers = np.bincount(self.status[mask], minlength=max(Status) + 1)
        return {code.name.lower(): int(numbers[code]) for code in Status}


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


def statistics(values: np.ndarray) -> dict[str, float]:
    """Return the median and the 5th and 95th percentile of what was measured, for the report."""
    if values.size == 0:
        return {}
    low, middle, high = np.percentile(values.astype(np.float64), [5, 50, 95])
    return {"p05": float(f"{low:.6g}"), "median": float(f"{middle:.6g}"), "p95": float(f"{high:.6g}")}


@dataclass(frozen=True)
class RangeImage:
    """Ranges along the rays, before correction and filters; pixels with a status of kernels.status.ESTIMATED have values that count."""

    method: str
    range_m: np.ndarray  # [pixel] float32
    sigma_m: np.ndarray  # [pixel] float32
    amplitude: np.ndarray  # [pixel] float32
    confidence: np.ndarray  # [pixel] float32
    status: np.ndarray  # [pixel] int32
    facts: dict[str, Any]
    least_confidence: float = 0.0
    """Least confidence of a range that counts as solved, where the request names none."""
    warnings: tuple[str, ...] = ()
    """A sentence for each thing that does not fit on the whole scene."""


WHITE_PERCENTILE = 99.0
"""Percentile of the brightest channel that is shown as full white, so that a few highlights do not darken the cloud."""


def point_cloud(solution: DepthSolution, camera: Camera, *, color_space: str, normals: bool) -> PointCloud:
    """Return one point for each solved pixel, row by row; or the measured places between pixels, if the method has them."""
    solved = solution.solved
    if solution.points is not None and solution.pixels is not None:
        kept = solved[tuple(solution.pixels.T)]
        rows, cols = solution.pixels[kept].T
        points = solution.points[kept]
    else:
        rows, cols = np.nonzero(solved)
        x, y = camera.plane_coordinates()
        depth = solution.depth[rows, cols].astype(np.float64)
        spread = depth if camera.projection == "perspective" else 1.0
        points = np.stack([x[rows, cols] * spread, y[rows, cols] * spread, -depth], axis=-1)
    colours = display_colours(solution, color_space)[rows, cols]
    found = depth_normals(solution.depth, solved, camera, sigma=solution.sigma)[rows, cols] if normals else None
    return PointCloud(points.astype(np.float32), colours, found)


def display_colours(solution: DepthSolution, color_space: str) -> np.ndarray:
    """Return what the scene looks like under even light, its brightest one per cent white: [rows, cols, 3] uint8, sRGB."""
    linear = solution.colour
    if linear is None:
        grey = np.zeros(solution.depth.shape, np.float32) if solution.amplitude is None else solution.amplitude
        linear = np.repeat(grey[..., None], 3, axis=-1)
    return srgb_bytes(linear, white_of(linear[solution.solved].max(axis=-1, initial=0.0)), linear_space(color_space))


def white_of(seen: np.ndarray) -> float:
    """Return the light that is shown as full white; 0 where nothing is seen."""
    return float(np.percentile(seen, WHITE_PERCENTILE)) if seen.size else 0.0


def srgb_bytes(linear: np.ndarray, white: float, color_space: str) -> np.ndarray:
    """Return linear colours for display, [rows, cols, 3] uint8, sRGB, `white` as 255; middle grey if white is 0."""
    shown = np.clip(linear / white, 0, 1) if white > 0 else np.full_like(linear, 0.5)
    encoded = convert(np.ascontiguousarray(shown, dtype=np.float32), color_space, "srgb_texture")
    return np.rint(255 * np.clip(encoded, 0, 1)).astype(np.uint8)
