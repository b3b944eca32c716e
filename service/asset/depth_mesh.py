"""A measured depth as a mesh that is cut where one surface stands in front of another: arrays only, no USD."""

import numpy as np

from service.asset.links import Links
from service.asset.mesh import SurfaceMesh, height_mesh, valid_heights
from stage.depth_breaks import connected
from stage.depth_maps import DEPTH_FILE, DepthMaps
from stage.maps import SurfaceMaps

LEAST_SHARE = 0.5
"""Share of the pixels with a depth that a mesh must hold, or its user is told."""


def depth_mesh(maps: DepthMaps) -> SurfaceMesh:
    """Return faces between neighbouring pixels, without those across a break of the depth (stage.depth_breaks).

    Args:
        maps: a depth; pixels whose depth is not finite, or not in front of a perspective camera, get no vertex.

    Raises:
        AssetError: there is no face.
    """
    surface = SurfaceMaps(camera=maps.camera, mask=maps.mask, height=-maps.depth)
    valid = valid_heights(surface)
    depth = np.where(valid, maps.depth, 1)
    right, down = (connected(depth, valid, maps.camera, offset, sigma=maps.sigma) for offset in ((0, 1), (1, 0)))
    return height_mesh(surface, links=_without_mixed(Links(right[:, :-1], down[:-1])))


def mesh_warnings(mesh: SurfaceMesh, maps: DepthMaps) -> tuple[str, ...]:
    """Return a sentence if most pixels with a depth are not in the mesh, as with laser stripes that lie apart."""
    pixels = np.count_nonzero(maps.mask[::mesh.step, ::mesh.step])
    if mesh.centred >= LEAST_SHARE * pixels:
        return ()
    return (f"{DEPTH_FILE}: the mesh holds {mesh.centred} of {pixels} pixels with a depth, for the others have too few neighbours on one "
            "surface: --geometry points shows all",)


def _without_mixed(links: Links) -> Links:
    """Return the links without those of pixels that have none to the left and right, or none upwards and downwards.

    Such a pixel sees the edge of one surface before another. Along a slanted edge these pixels see more and more of the far surface, and
    would make gentle bridges between the two.
    """
    beside, above = np.pad(links.right, ((0, 0), (1, 1))), np.pad(links.down, ((1, 1), (0, 0)))
    kept = (beside[:, :-1] | beside[:, 1:]) & (above[:-1] | above[1:])
    return Links(links.right & kept[:, :-1] & kept[:, 1:], links.down & kept[:-1] & kept[1:])
