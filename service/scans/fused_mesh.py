"""Fused surfaces as meshes with colours, and what reports say of their scans."""

from typing import Any

import numpy as np

from service.scans.fused_bricks import FusedBricks
from service.scans.fused_surface import BrickSurface, Surface, Tally
from service.scans.range_images import COLOUR, channels
from stage.colour.colour import convert
from stage.results.mesh import TriangleMesh

SEEN_BY = (1, 2, 3, 5)
"""Numbers of scans for which reports say what share of the area so many see."""


def triangle_mesh(surface: Surface | BrickSurface, names: tuple[str, ...]) -> TriangleMesh:
    """Return a surface as a mesh with the colours of its vertices, where any scan has some."""
    colours = None
    if COLOUR in names:
        first = channels(names)[COLOUR].start - 3  # behind the normal
        values, weight = surface.values[:, first:first + 3], surface.values[:, first + 3:first + 4]
        linear = np.where(weight > 0, values / np.where(weight > 0, weight, 1), 0).astype(np.float32)
        display = convert(linear[None], "lin_rec709_scene", "srgb_rec709_scene")[0] if len(linear) else linear
        colours = np.rint(np.clip(display, 0, 1) * 255).astype(np.uint8)
    return TriangleMesh(surface.points.astype(np.float32), surface.normals, surface.sigma, surface.seen, colours, surface.faces)


def scan_facts(fused: FusedBricks, tallies: list[Tally]) -> list[dict[str, Any]]:
    """Return what the report says of each scan."""
    of_scan = dict(zip(fused.used, tallies, strict=True))
    return [{"name": scan.name, "fused": number in of_scan, "photometric_normals": scan.photometric, "square_px": scan.square_px,
             "compared_pixels": fused.placings[number].compared, "displacement_m": short(fused.placings[number].displacement_m),
             **(_tally(of_scan[number]) if number in of_scan else {})} for number, scan in enumerate(fused.summaries)]


def _tally(tally: Any) -> dict[str, Any]:
    pixels = max(tally.pixels, 1)
    return {"pixels": tally.pixels, "fused_share": round(tally.fused / pixels, 5), "seen_through_share": round(tally.refused / pixels, 5),
            "lost_share": round(tally.lost / pixels, 5), "residual_rms_m": short(tally.rms_m),
            "residual_median_sigmas": round(tally.median_sigmas, 3)}


def short(value: Any) -> float:
    """Return a number as reports have it, with four digits."""
    return float(f"{float(value):.4g}")
