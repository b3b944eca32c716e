"""What is wrong with the normals and the height of maps that other programs have changed: the length of normals, axes that are not those of
the camera frame, and another unit of the height.

Normals and height are of one surface. The rotation or mirroring that takes the normals to those of the height best (orthogonal Procrustes,
Schönemann, Psychometrika 31, 1966) is none where both are in the camera frame, however noisy they are.
"""

import numpy as np

from stage.capture.camera import Camera

SITES, LEAST_SITES = 5000, 200
"""Most places, spread over the object, at which normals are compared with the height, and the fewest that tell anything."""
LENGTH = 0.05
"""Largest median deviation of the length of normals from 1: those that are stored as 0…1 are .2 off, resampled ones .02."""
LEAST_DEGREES, TIMES, LEAST_TURN = 4.0, 4.0, 30.0
"""Median angle between normals and height, by how many times another frame makes it smaller, and by how many degrees that is turned, from
which on it is named: of 950 solved maps, many of them poor, it makes it smaller by 1.2 times at most, and by 2.5 where the lights of the
capture were turned; exchanged and negated axes of these by 10 to 300."""
LEAST_SLOPE, LEAST_FACING, LEAST_FACTOR = 0.1, 0.2, 1.25
"""Slope of normals and cosine to the view axis from which on they tell by how much the height is too high or too flat, and the factor from
which on that is named: 700 solved maps are .5 to 1.03 times as high, and where they are 4° apart another unit leaves no less than 1/1.6."""
NEAREST = 0.5
"""Part of the distance of the surface that the camera has (`surface_z_m`) at which the height may lie; it may lie as much farther: in
solved maps it lies at .98 to 1.09 of it."""
NEAR = 0.3
"""Largest entry by which a matrix differs from one that exchanges and negates axes, to be told as that."""


def normal_fault(camera: Camera, mask: np.ndarray, normal: np.ndarray, height: np.ndarray | None, part: np.ndarray | None) -> str | None:
    """Return a sentence about normals that are none of the camera frame, or a height that is in another unit than theirs, or None.

    Args:
        mask: [rows, cols] bool.
        normal: [rows, cols, 3].
        height: [rows, cols] camera-frame z; None: the length of the normals alone is looked at.
        part: [rows, cols] number of the part of the surface; None: there is one.
    """
    inside = np.flatnonzero(mask)
    some = inside[np.unique(np.linspace(0, len(inside) - 1, min(SITES, len(inside))).astype(int))]
    length = np.linalg.norm(normal.reshape(-1, 3)[some], axis=1)
    some, length = some[length > 0], length[length > 0]
    if len(some) >= LEAST_SITES and abs(np.median(length) - 1) > LENGTH:
        return (f"layer normal has vectors that are {np.median(length):.2f} long in the median, not 1, as where they are stored as 0…1: "
                "give unit vectors of the camera frame (x right, y up, z towards the viewer)")
    rows, cols = mask.shape
    row, col = np.divmod(some, cols)
    at = some[(row > 0) & (row < rows - 1) & (col > 0) & (col < cols - 1)]
    around = at + np.array([[1], [-1], [-cols], [cols]])
    same = mask.reshape(-1)[around] if part is None else mask.reshape(-1)[around] & (part.reshape(-1)[around] == part.reshape(-1)[at])
    at, around = at[same.all(axis=0)], around[:, same.all(axis=0)]
    if height is None or len(at) < LEAST_SITES:
        return None
    right, left, above, below = (camera.points_at(pixels, height.reshape(-1)[pixels]).astype(np.float64) for pixels in around)
    surface = np.cross(right - left, above - below)
    surface /= np.maximum(np.linalg.norm(surface, axis=1, keepdims=True), 1e-300)
    own = normal.reshape(-1, 3)[at]
    if (scaled := _scale_fault(camera, own, surface, height.reshape(-1)[at])) is not None:
        return scaled
    first, _, second = np.linalg.svd(surface.T @ own)
    matrix = first @ second
    apart, left_over = (float(np.degrees(np.arccos(np.clip(np.median((surface * vectors).sum(axis=1)), -1, 1))))
                        for vectors in (own, own @ matrix.T))
    turned = float(np.degrees(np.arccos(np.clip((np.trace(matrix * np.linalg.det(matrix)) - 1) / 2, -1, 1))))
    if apart < LEAST_DEGREES or apart < TIMES * left_over or (turned < LEAST_TURN and np.linalg.det(matrix) > 0):
        return None
    axes = np.round(matrix)
    words = f"turned by {turned:.0f}°, as from another frame" if np.abs(matrix - axes).max() > NEAR else "read as ({})".format(
        ", ".join(("-" if line.sum() < 0 else "") + "XYZ"[int(np.argmax(np.abs(line)))] for line in axes))
    return (f"layers normal and height are not of one surface: they are {apart:.0f}° apart in the median, and {left_over:.1f}° with normal "
            f"{words}: give normals in the camera frame (x right, y up, z towards the viewer), and the height as its z")


def _scale_fault(camera: Camera, own: np.ndarray, surface: np.ndarray, height: np.ndarray) -> str | None:
    """Return a sentence about a height [n] in another unit than its camera has, by normals and those of the height, [n, 3]; or None."""
    if camera.projection == "perspective":  # at any distance it has the same normals
        middle, far = float(np.median(height)), camera.surface_z_m
        if far is None or NEAREST <= middle / far <= 1 / NEAREST:
            return None
        return (f"layer height is {middle:.4g} in the median, and its camera has the surface at {far:.4g} m (surface_z_m): give it in "
                "metres, as the z of the camera frame")
    used = np.minimum(own[:, 2], surface[:, 2]) > 1e-6
    wanted, given = (-vectors[used, :2] / vectors[used, 2:] for vectors in (own, surface))
    steep = np.linalg.norm(wanted, axis=1)
    tell = (steep > LEAST_SLOPE) & (own[used, 2] > LEAST_FACING)
    if tell.sum() < LEAST_SITES:
        return None
    factor = float(np.median((wanted * given).sum(axis=1)[tell] / steep[tell] ** 2))
    if not 0 < factor < np.inf or max(factor, 1 / factor) < LEAST_FACTOR:
        return None
    apart, left_over = (float(np.degrees(np.median(np.abs(np.arctan(steep) - np.arctan(np.linalg.norm(slopes, axis=1)))[tell])))
                        for slopes in (given, given / factor))
    if apart < LEAST_DEGREES or apart < TIMES * left_over:
        return None
    unit = "metres" if camera.pixel_size_m is not None else "pixels"
    return f"layer height is {factor:.4g} times as high as layer normal says: give it in {unit}, as the z of the camera frame"
