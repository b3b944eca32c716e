"""How far the planes of a sweep may be off: how depths change with them, and whether another sweep confirms them.

One sweep gives a surface as smooth as the true one under planes that are all off by one frame, or turned alike; nothing in it tells them.
Stripes across the rows and stripes across the columns see the same surfaces, and do.
"""

from collections.abc import Sequence

import numpy as np

from kernels.structured.stripe import plane_depths
from service.depth.laser.stripe_map import StripeMap, StripeSamples
from stage.capture.camera import Camera
from stage.capture.light import LaserPlane

ENOUGH = 30
"""Number of pixels under both sweeps from which on these are compared."""
CLEAR_SIGMAS = 3.0
"""Median difference of two sweeps, in deviations, from which on they contradict each other."""


def depth_per_turn(x: np.ndarray, y: np.ndarray, depth: np.ndarray, laser: LaserPlane) -> np.ndarray:
    """Return the change of the depths of points on a plane for each radian by which it turns about its point nearest to the camera, where
    the laser is about; metres, for the axis that makes most of it."""
    normal = np.array(laser.normal) / np.linalg.norm(laser.normal)
    foot = normal * np.dot(laser.point_m, normal)
    away = np.stack([x * depth, y * depth, -depth], axis=-1) - foot
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.linalg.norm(away, axis=-1) / np.abs(x * normal[0] + y * normal[1] - normal[2]))


def unconfirmed(samples: Sequence[StripeSamples], planes: Sequence[LaserPlane], camera: Camera, *, along: str) -> str | None:
    """Return a sentence about planes whose accuracy nobody declares: what one sweep does not tell, and what it would make.

    Args:
        samples: the samples of each frame whose stripe crosses the same lines; their depth is 0 where there is none.
        planes: the plane of each of these frames, in the same order.
    """
    turned, moved = [], []
    for index, (part, plane) in enumerate(zip(samples, planes, strict=True)):
        other = planes[index + 1 if index + 1 < len(planes) else index - 1]
        seen = part.depth > 0
        u, v = (part.place, part.line + 0.5) if along == "row" else (part.line + 0.5, part.place)
        x, y = camera.plane_at(u[seen].astype(np.float64), v[seen].astype(np.float64))
        turned.append(np.radians(1) * depth_per_turn(x, y, part.depth[seen], plane))
        moved.append(np.abs(plane_depths(x, y, np.array(other.point_m), np.array(other.normal), along=along).depth - part.depth[seen]))
    if not turned or not np.isfinite(np.concatenate(turned)).any():
        return None
    degree, one_frame, aside = 1000 * float(np.nanmedian(np.concatenate(turned))), np.concatenate(moved), ""
    if len(planes) > 1 and np.isfinite(one_frame).any():
        aside = f", or by {1000 * float(np.nanmedian(one_frame)):.3g} mm if all are off by one frame"
    return (f"frames[].laser: one sweep does not tell whether its planes are right: depths are off by {degree:.3g} mm for each degree "
            f"that all are turned by{aside}, and the standard deviations hold the light alone: give accuracy_deg, which they then hold, "
            "or sweep planes across the other axis too")


def compare_sweeps(rows: StripeMap, columns: StripeMap) -> tuple[float, float] | None:
    """Return the median difference of the depths of two sweeps, metres, and in their deviations; None if they share too few pixels."""
    both = rows.solved & columns.solved
    if both.sum() < ENOUGH:
        return None
    away = np.abs(rows.depth[both].astype(np.float64) - columns.depth[both])
    return float(np.median(away)), float(np.median(away / np.maximum(np.hypot(rows.sigma[both], columns.sigma[both]), 1e-12)))
