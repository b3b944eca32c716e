"""A measured depth as a mesh that is cut where one surface stands in front of another: arrays only, no USD."""

import numpy as np

from service.asset.links import Links
from service.asset.mesh import SurfaceMesh, height_mesh, valid_heights
from stage.depth_breaks import connected
from stage.depth_maps import DepthMaps
from stage.maps import SurfaceMaps


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
    return height_mesh(surface, links=Links(right[:, :-1], down[:-1]))
