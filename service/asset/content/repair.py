"""Heights that stand off the surface around them, put back along the normals.

Integration of wrong normals leaves spikes: single pixels, or a few, whose height no neighbour's normal leads to. They are linked to nothing
around them (service/asset/content/links.py), so that a mesh would have a hole there.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from service.asset.content.links import ISLAND_PIXELS, height_of, relief, slopes, surface_links, touched, without_islands
from service.asset.content.mesh import valid_heights
from service.errors import SurfaceError
from stage.results.maps import SurfaceMaps

MOST_SPIKES = 0.05
"""Part of the surface above which spikes are no longer single faults: height and normals are of two different surfaces."""
TOLD = 1e-3
"""Part of the surface from which repaired and left-out pixels are worth a sentence: below it they are those of a sound solve's edges."""


class Repaired(NamedTuple):
    """Maps without spikes, and what their user should know."""

    maps: SurfaceMaps
    spikes: int  # pixels whose height was replaced
    warnings: tuple[str, ...]  # sentences


def repair_heights(maps: SurfaceMaps) -> Repaired:
    """Replace heights that stand off all of their neighbours, by what these and the normals say; without normals, none.

    A spike is a patch of at most a few linked pixels within a part of the object. Its pixels become, ring by ring, the mean of what the
    neighbours that are known say: their relief and the mean slope of both normals.
    """
    valid = valid_heights(maps)
    if maps.normal is None or not valid.any():
        return Repaired(maps, 0, ())
    assert maps.height is not None
    known = touched(without_islands(surface_links(maps, valid)))
    rows, cols = np.nonzero(valid & ~known)
    spikes, most = 0, MOST_SPIKES * np.count_nonzero(valid)
    if len(rows):
        height, slope = relief(np.where(valid, maps.height, -1), maps.camera), slopes(maps.normal, maps.camera)
    changed = np.zeros_like(known)
    while len(rows):
        total, count = np.zeros(len(rows)), np.zeros(len(rows), dtype=np.int64)
        for (down, right), along in zip(((0, 1), (1, 0), (0, -1), (-1, 0)), (*slope, *slope), strict=True):
            near = np.clip(rows + down, 0, known.shape[0] - 1), np.clip(cols + right, 0, known.shape[1] - 1)
            used = known[near] if maps.part is None else known[near] & (maps.part[near] == maps.part[rows, cols])
            rise = -(down + right) * (along[near] + along[rows, cols]) / 2
            total += np.where(used, height[near] + rise, 0)
            count += used
        ring = count > 0
        if not ring.any():
            break
        filled = rows[ring], cols[ring]
        height[filled] = total[ring] / count[ring]
        changed[filled] = known[filled] = True
        spikes += len(filled[0])
        rows, cols = rows[~ring], cols[~ring]
        if spikes > most:
            raise SurfaceError(f"the height stands off that of all neighbours, unlike the normals say, in more than {MOST_SPIKES:.0%} of "
                               "the pixels, so that there is no surface to export: solve again, with --method svbrdf or with more lights")
    told = TOLD * np.count_nonzero(valid)
    warnings = []
    if spikes > told:
        warnings.append(f"height: {spikes} pixels stood off all of their neighbours, unlike their normals say, and were put back along the "
                        "normals")
    if len(rows) > told:
        warnings.append(f"geometry: {len(rows)} pixels are left out: they are islands of fewer than {ISLAND_PIXELS} pixels")
    if spikes:
        maps = replace(maps, height=np.where(changed, height_of(height, maps.camera), maps.height).astype(np.float32))
    return Repaired(maps, spikes, tuple(warnings))
