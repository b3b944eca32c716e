"""Photometric normals of many views and the depth of all, joined on the fused mesh."""

from typing import Any

import numpy as np

from service.errors import RequestError
from service.scans.fused_bricks import FusedBricks
from service.scans.surface import Surface
from stage.meshes.joined_normals import join_normals

NORMAL_SIGMA = float(np.radians(1.0))
"""Standard deviation of photometric normals whose maps do not say it."""
MOST_CONTRADICTED = 0.5
"""Part of the vertices with photometric normals at which these may contradict the depth before both are refused as not of one surface."""


def with_joined_normals(surface: Surface, fused: FusedBricks, where: str) -> tuple[Surface, dict[str, Any]]:
    """Return a surface that has the photometric normals of its views, and what the report says of it.

    Args:
        surface: of all bricks.
        fused: where it comes from.
        where: what messages begin with.

    Raises:
        RequestError: normals and depth contradict each other at most vertices.
    """
    summaries = [fused.summaries[number] for number in fused.used]
    told = [summary.normal_sigma for summary in summaries if summary.normal_sigma > 0]
    tilt = float(np.median(told)) if told else NORMAL_SIGMA
    found = join_normals(surface.points, surface.faces, surface.sigma, surface.normals, np.where(surface.photometric, tilt, np.inf),
                         pixel_m=float(np.median([summary.pitch for summary in summaries])))
    contradicted = found.contradicted / max(int(found.used.sum()), 1)
    if contradicted > MOST_CONTRADICTED:
        raise RequestError(f"{where}: the photometric normals contradict the depth at {contradicted:.0%} of the vertices: the maps are of "
                           "other scans, their axes are flipped, or the σ of the depth is too small: leave out --join-normals")
    moved = float(np.sqrt(np.mean(found.moved[found.used].astype(np.float64) ** 2))) if found.used.any() else 0.0
    facts = {"vertices_share": round(float(found.used.mean()), 4), "moved_rms_m": float(f"{moved:.4g}"),
             "normal_sigma_degrees": float(f"{np.degrees(tilt):.4g}"), "normal_drift_degrees": float(f"{found.drift_degrees:.4g}"),
             "contradicted_vertices": found.contradicted,
             "contradicted_share": round(contradicted, 4)}
    return surface._replace(points=found.points, normals=found.normals.astype(np.float32)), facts
