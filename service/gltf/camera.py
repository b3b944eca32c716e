"""The capturing camera as a camera of glTF.

Source: glTF 2.0 Specification, 3.10 "Cameras".
"""

import math

import numpy as np
import pygltflib as gltf

from service.asset.view import view_of
from stage.camera import Camera

FREE_OFFSET_PX = 0.5
"""How far a principal point may lie from the centre of the image before the camera is said to differ from the capturing one."""


def camera_and_place(camera: Camera, extent: np.ndarray, *, unit_m: float) -> tuple[gltf.Camera, list[float]]:
    """Return the camera, and where it stands in the camera frame, in metres.

    Args:
        extent: [2, 3] bounding box of the surface, camera frame, in units of the height map.
        unit_m: metres of such a unit.

    Convention:
        A camera of glTF looks along -z with +y up, as the camera frame has it. An orthographic one is moved sideways by what its principal
        point is off the centre; a perspective one has no place for that (`principal_offset`), nor for lens distortion.
    """
    view = view_of(camera, extent)
    near, far = view.near * unit_m, view.far * unit_m
    if camera.projection == "perspective":
        assert camera.focal_px is not None  # the camera's validator saw to it
        half_width, half_height = camera.width / 2 / camera.focal_px[0], camera.height / 2 / camera.focal_px[1]
        lens = gltf.Perspective(yfov=2 * math.atan(half_height), aspectRatio=half_width / half_height, znear=near, zfar=far)
        return gltf.Camera(type="perspective", perspective=lens, name="Camera"), [0.0, 0.0, 0.0]
    pixel = (camera.pixel_size_m or 1.0) * unit_m
    box = gltf.Orthographic(xmag=camera.width * pixel / 2, ymag=camera.height * pixel / 2, znear=near, zfar=far)
    right, down = principal_offset(camera)
    return gltf.Camera(type="orthographic", orthographic=box, name="Camera"), [-right * pixel, down * pixel, view.z * unit_m]


def principal_offset(camera: Camera) -> tuple[float, float]:
    """Return how far the principal point lies to the right of the image centre and below it, in pixels."""
    cu, cv = camera.principal_point
    return cu - camera.width / 2, cv - camera.height / 2


def camera_warnings(camera: Camera) -> list[str]:
    """Return a sentence for what a camera of glTF cannot hold."""
    if camera.projection == "orthographic":
        return []
    right, down = principal_offset(camera)
    if max(abs(right), abs(down)) <= FREE_OFFSET_PX:
        return []
    return [f"camera: its principal point is {right:+.1f} px to the right of the image centre and {down:+.1f} px below it, which a "
            "camera of glTF cannot hold: it shows the asset shifted by as much; a .usdc keeps it"]
