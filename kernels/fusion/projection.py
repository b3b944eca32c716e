"""The cameras of views: how points in space fall on an image, and the lines of sight of an image.

All cameras look along −z, with +x to the right and +y up. The lines of sight of a perspective camera start in its origin, those of an
orthographic one in the plane z = 0. Inverse depth is linear in the image on planes under a perspective camera, depth under an orthographic
one.
"""

import warp as wp

UNDISTORT_ITERATIONS = 10
"""Rounds of the iteration that undoes the distortion: ordinary lenses converge to single precision in about six."""


@wp.struct
class View:
    """The place and the camera of one range image."""

    first: int  # index of its first pixel in the arrays of all pixels
    first_tile: int
    rows: int
    cols: int
    first_row: int  # of its first pixel in the image: image coordinates do not depend on what part of it is here
    first_col: int
    rotation: wp.mat33  # camera from world
    translation: wp.vec3
    orthographic: bool
    focal: wp.vec2  # pixels; of an orthographic camera pixels for each metre
    principal: wp.vec2
    radial: wp.vec3
    tangential: wp.vec2
    distorted: bool


@wp.func
def to_camera(view: View, point: wp.vec3) -> wp.vec3:
    """Return a point in the camera frame of a view."""
    return view.rotation * point + view.translation


@wp.func
def turned_back(view: View, vector: wp.vec3) -> wp.vec3:
    """Return a vector of the camera frame of a view in the world frame."""
    return wp.transpose(view.rotation) * vector


@wp.func
def image_point(view: View, point: wp.vec3) -> wp.vec2:
    """Return the image coordinates u and v of a camera-frame point in front of the camera, with the distortion of the lens."""
    if view.orthographic:
        return wp.vec2(view.principal[0] + view.focal[0] * point[0], view.principal[1] - view.focal[1] * point[1])
    near = 1.0 / point[2]
    x = -point[0] * near
    y = point[1] * near
    u = float(x)
    v = float(y)
    if view.distorted:
        r2 = x * x + y * y
        radial = 1.0 + r2 * (view.radial[0] + r2 * (view.radial[1] + r2 * view.radial[2]))
        p = view.tangential
        u = x * radial + 2.0 * p[0] * x * y + p[1] * (r2 + 2.0 * x * x)
        v = y * radial + p[0] * (r2 + 2.0 * y * y) + 2.0 * p[1] * x * y
    return wp.vec2(view.principal[0] + view.focal[0] * u, view.principal[1] + view.focal[1] * v)


@wp.func
def line_of_sight(view: View, u: float, v: float) -> wp.vec3:
    """Return the direction of the line of sight of image coordinates, at which a depth of 1 m lies behind its start, camera frame.

    That of a perspective camera is (x, y, −1); the distortion is undone by fixed-point iteration.
    """
    if view.orthographic:
        return wp.vec3(0.0, 0.0, -1.0)
    x = (u - view.principal[0]) / view.focal[0]
    y = (v - view.principal[1]) / view.focal[1]
    ideal_x = float(x)
    ideal_y = float(y)
    p = view.tangential
    rounds = wp.where(view.distorted, UNDISTORT_ITERATIONS, 0)
    for _ in range(rounds):
        r2 = ideal_x * ideal_x + ideal_y * ideal_y
        radial = 1.0 + r2 * (view.radial[0] + r2 * (view.radial[1] + r2 * view.radial[2]))
        dx = ideal_x * radial + 2.0 * p[0] * ideal_x * ideal_y + p[1] * (r2 + 2.0 * ideal_x * ideal_x)
        dy = ideal_y * radial + p[0] * (r2 + 2.0 * ideal_y * ideal_y) + 2.0 * p[1] * ideal_x * ideal_y
        ideal_x = ideal_x + x - dx
        ideal_y = ideal_y + y - dy
    return wp.vec3(ideal_x, -ideal_y, -1.0)


@wp.func
def sight_start(view: View, u: float, v: float) -> wp.vec3:
    """Return the point of the camera frame in which the line of sight of image coordinates starts."""
    if view.orthographic:
        return wp.vec3((u - view.principal[0]) / view.focal[0], (view.principal[1] - v) / view.focal[1], 0.0)
    return wp.vec3(0.0, 0.0, 0.0)


@wp.func
def in_front(view: View, point: wp.vec3) -> bool:
    """Return whether a camera-frame point has an image: an orthographic camera sees it wherever it is."""
    return view.orthographic or point[2] < 0.0


@wp.func
def toward_camera(view: View, point: wp.vec3) -> wp.vec3:
    """Return the vector from a camera-frame point towards the camera, of any length."""
    return wp.where(view.orthographic, wp.vec3(0.0, 0.0, 1.0), -point)


@wp.func
def pixel_metres(view: View, depth: float) -> float:
    """Return the distance in metres of neighbouring pixels at a depth."""
    return wp.where(view.orthographic, 1.0, depth) / wp.min(view.focal[0], view.focal[1])


@wp.func
def linear_of(view: View, depth: float) -> float:
    """Return what is linear in the image on planes: the inverse of a depth, or the depth itself."""
    return wp.where(view.orthographic, depth, 1.0 / depth)


@wp.func
def depth_of(view: View, linear: float) -> float:
    """Return the depth of what `linear_of` returns."""
    return wp.where(view.orthographic, linear, 1.0 / linear)
