"""A measured depth as an asset has it: a mesh that is cut where one surface stands in front of another, and the measured points."""

from typing import NamedTuple

import numpy as np

from service.asset.content.links import Links
from service.asset.content.mesh import SurfaceMesh, height_mesh, valid_heights
from service.asset.content.metallic import MetallicLook, metallic_look
from service.asset.content.textures import BLEED_TEXELS, bleed
from service.errors import SurfaceError
from stage.capture.camera import Camera
from stage.colour.colour import convert
from stage.formats.ply import POINTS_FILE, PointCloud
from stage.results.depth_breaks import connected
from stage.results.depth_maps import DEPTH_FILE, DepthMaps
from stage.results.maps import SurfaceMaps

LEAST_AGREEMENT = 0.9
"""The least share of points that lie in pixels of the depth, if both are of one measurement: lasers measure some beside their pixel."""
POINT_WIDTH = 1.5
"""Width of a point in footprints of a pixel: neighbouring points just overlap, corner to corner."""
GREY = np.full((1, 3), 0.5, np.float32)
"""Linear colour where none is known."""
UNCERTAINTY = ("sigma", "confidence")
"""Layers of a depth that its vertices and points carry: standard deviation in metres, and confidence 0…1."""
SAME_DEPTH = 0.1
"""The largest relative difference between the depths of a point and of its pixel, if both are of one measurement."""


class MeasuredPoints(NamedTuple):
    """Points in the camera frame, and the pixels that they lie in."""

    points: np.ndarray  # [n, 3] float32 metres
    rows: np.ndarray  # [n] int
    cols: np.ndarray  # [n] int
    colours: np.ndarray | None  # [n, 3] float32 scene-linear Rec.709, 0…1; None: not known
    normals: np.ndarray | None  # [n, 3] float32, unit; None: not known

    @property
    def extent(self) -> np.ndarray:
        """Return the bounding box, [2, 3] float32."""
        return np.stack([self.points.min(axis=0), self.points.max(axis=0)])

    def widths(self, camera: Camera, step: int = 1) -> np.ndarray:
        """Return the diameters [n], metres, of points that just overlap those `step` pixels beside them in the image."""
        if camera.focal_px is None:
            return np.full(len(self.points), POINT_WIDTH * step * (camera.pixel_size_m or 1.0))
        return np.asarray(POINT_WIDTH * step * (np.abs(self.points[:, 2]) / min(camera.focal_px)))

    def every(self, step: int) -> "MeasuredPoints":
        """Return the points in every step-th row and column of pixels."""
        kept = (self.rows % step == 0) & (self.cols % step == 0)
        return MeasuredPoints(self.points[kept], self.rows[kept], self.cols[kept], None if self.colours is None else self.colours[kept],
                              None if self.normals is None else self.normals[kept])


def measured_points(maps: DepthMaps, cloud: PointCloud | None) -> MeasuredPoints:
    """Return the points of a depth; `cloud`: what points.ply holds; None: a point is made for each pixel of the depth, without a colour."""
    if cloud is None:
        rows, cols = np.nonzero(valid_heights(SurfaceMaps(camera=maps.camera, mask=maps.mask, height=-maps.depth)))
        found = MeasuredPoints(maps.camera.points(-maps.depth)[rows, cols], rows, cols, None, None)
    else:
        found = _of_cloud(maps, cloud)
    if len(found.points) == 0:
        raise SurfaceError("the depth has no point, so there is nothing to export")
    return found


def colour_image(measured: MeasuredPoints, mask: np.ndarray) -> np.ndarray | None:
    """Return the colours of the points as an image, [rows, cols, 3] float32 scene-linear Rec.709; None if they have none.

    Pixels of the mask without a point of their own take the colour of the pixels around them.
    """
    if measured.colours is None:
        return None
    image, known = np.zeros((*mask.shape, 3), np.float32), np.zeros(mask.shape, dtype=bool)
    image[measured.rows, measured.cols] = measured.colours
    known[measured.rows, measured.cols] = True
    return image if known[mask].all() else bleed(image, known, reach=BLEED_TEXELS)


def photographed(maps: DepthMaps, colours: np.ndarray) -> tuple[SurfaceMaps, MetallicLook]:
    """Return the maps and the look of a surface whose albedo is a photograph, [rows, cols, 3] of colour_image."""
    seen = SurfaceMaps(camera=maps.camera, mask=maps.mask, diffuse_albedo=colours, color_space="lin_rec709_scene")
    return seen, metallic_look(seen)


def colour_warnings(measured: MeasuredPoints) -> tuple[str, ...]:
    """Return a sentence for an asset whose colours are not known."""
    if measured.colours is None:
        return (f"{DEPTH_FILE}: there is no {POINTS_FILE} beside it, which holds the colours: the asset is grey",)
    return ()


def linear_colours(codes: np.ndarray) -> np.ndarray:
    """Return [n, 3] float32 scene-linear Rec.709 values of [n, 3] uint8 sRGB codes."""
    return convert((codes.astype(np.float32) / 255)[None], "srgb_texture", "lin_rec709_scene")[0]


def _of_cloud(maps: DepthMaps, cloud: PointCloud) -> MeasuredPoints:
    """Return the points of a cloud that are finite and, under a perspective camera, in front of it."""
    seen = np.isfinite(cloud.points).all(axis=-1)
    if maps.camera.projection == "perspective":
        seen &= cloud.points[:, 2] < 0
    points = cloud.points[seen]
    rows, cols, inside = maps.camera.pixels_of(points)
    depth = maps.depth[rows, cols]
    agree = np.count_nonzero(inside & maps.mask[rows, cols] & (np.abs(depth + points[:, 2]) <= SAME_DEPTH * np.abs(depth)))
    if agree < LEAST_AGREEMENT * len(cloud.points) or (len(cloud.points) == 0 and maps.mask.any()):
        raise SurfaceError(f"{POINTS_FILE} and {DEPTH_FILE} are not of one measurement: {agree} of {len(cloud.points)} points lie on a "
                           f"pixel of the depth: run `relit depth` again, or move {POINTS_FILE} away to export without colours")
    return MeasuredPoints(points, rows, cols, linear_colours(cloud.colours[seen]), None if cloud.normals is None else cloud.normals[seen])


LEAST_SHARE = 0.5
"""Share of the pixels with a depth that a mesh must hold, or its user is told."""


def depth_mesh(maps: DepthMaps) -> SurfaceMesh:
    """Return faces between neighbouring pixels, without those across a break of the depth (stage.results.depth_breaks).

    Pixels whose depth is not finite, or not in front of a perspective camera, get no vertex.
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
