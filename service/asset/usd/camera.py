"""The capturing camera as UsdGeom.Cameras, through which a DCC application shows the asset as it was captured.

An orthographic capture has a second, perspective camera, so far away that it shows the same picture: Blender 5.0 takes the aperture of an
orthographic camera, which is in tenths of a scene unit, as its width in metres, and so shows ten times as much in each direction.

Source: OpenUSD, UsdGeomCamera: apertures, focal length and their units.
"""

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom

from service.asset.content.camera import ORTHOGRAPHIC_CLEARANCE, view_of
from stage.capture.camera import Camera

CAMERA, FAR_CAMERA = "Camera", "CameraPerspective"
"""Names of the prims."""

FILM_WIDTH_M = 0.036
"""Width of the film gate. Only its ratio to the focal length is known; 36 mm is what DCCs start from."""

APERTURE_UNIT = 0.1
"""USD gives focal lengths and apertures in tenths of a scene unit (UsdGeomCamera, "Units of Measure")."""

PARALLAX_PX = 0.05
"""The largest distance in pixels between the images of a surface point in the far and in the orthographic camera."""


def define_cameras(usd_stage: Usd.Stage, root: Sdf.Path, camera: Camera, extent: np.ndarray) -> None:
    """Define, below the root, the camera whose picture is exactly the image, and for an orthographic one its far perspective twin.

    Args:
        extent: [2, 3] bounding box of the surface, camera frame, scene units; it sets the clipping ranges, and where the cameras of an
            orthographic capture stand.

    Convention:
        Lens distortion has no place in a UsdGeomCamera: the camera is the ideal one, as the mesh is.
    """
    prim = UsdGeom.Camera.Define(usd_stage, root.AppendChild(CAMERA))
    view = view_of(camera, extent)
    prim.CreateClippingRangeAttr(Gf.Vec2f(view.near, view.far))
    if camera.projection == "perspective":
        assert camera.focal_px is not None  # the camera's validator saw to it
        film_width = FILM_WIDTH_M / UsdGeom.GetStageMetersPerUnit(usd_stage)
        focal = film_width * camera.focal_px[0] / camera.width
        prim.CreateProjectionAttr(UsdGeom.Tokens.perspective)
        prim.CreateFocalLengthAttr(focal / APERTURE_UNIT)
        _set_aperture(prim, camera, (focal / camera.focal_px[0], focal / camera.focal_px[1]))
    else:
        pixel = camera.pixel_size_m or 1.0
        prim.CreateProjectionAttr(UsdGeom.Tokens.orthographic)
        prim.AddTranslateOp().Set(Gf.Vec3d(0, 0, view.z))
        _set_aperture(prim, camera, (pixel, pixel))
        _define_far_camera(usd_stage, root.AppendChild(FAR_CAMERA), camera, extent)


def _define_far_camera(usd_stage: Usd.Stage, path: Sdf.Path, camera: Camera, extent: np.ndarray) -> None:
    """Define a perspective camera that shows the middle depth of the surface as the orthographic camera does, and the rest nearly so.

    It stands before the middle of the image, so that it needs no aperture offsets, which not every client reads.
    """
    pixel = camera.pixel_size_m or 1.0
    x, y = camera.plane_at(np.array(camera.width / 2), np.array(camera.height / 2))
    middle, half_depth = float(extent[:, 2].mean()), float(extent[1, 2] - extent[0, 2]) / 2
    half_diagonal_px = float(np.hypot(camera.width, camera.height)) / 2
    distance = half_depth * (1 + half_diagonal_px / PARALLAX_PX) + camera.width * pixel  # a flat surface has no depth
    pixel_on_film = FILM_WIDTH_M / UsdGeom.GetStageMetersPerUnit(usd_stage) / camera.width
    prim = UsdGeom.Camera.Define(usd_stage, path)
    prim.CreateProjectionAttr(UsdGeom.Tokens.perspective)
    prim.CreateFocalLengthAttr(pixel_on_film * distance / pixel / APERTURE_UNIT)
    prim.CreateHorizontalApertureAttr(camera.width * pixel_on_film / APERTURE_UNIT)
    prim.CreateVerticalApertureAttr(camera.height * pixel_on_film / APERTURE_UNIT)
    prim.AddTranslateOp().Set(Gf.Vec3d(float(x), float(y), middle + distance))
    margin = half_depth + ORTHOGRAPHIC_CLEARANCE * camera.width * pixel
    prim.CreateClippingRangeAttr(Gf.Vec2f(max(distance - margin, distance / 2), distance + margin))


def _set_aperture(prim: UsdGeom.Camera, camera: Camera, pixel: tuple[float, float]) -> None:
    """Write the size of the image and the place of its principal point, from the width and height of a pixel in scene units."""
    cu, cv = camera.principal_point
    prim.CreateHorizontalApertureAttr(camera.width * pixel[0] / APERTURE_UNIT)
    prim.CreateVerticalApertureAttr(camera.height * pixel[1] / APERTURE_UNIT)
    prim.CreateHorizontalApertureOffsetAttr((camera.width / 2 - cu) * pixel[0] / APERTURE_UNIT)
    prim.CreateVerticalApertureOffsetAttr((cv - camera.height / 2) * pixel[1] / APERTURE_UNIT)
