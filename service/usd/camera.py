"""The capturing camera as a UsdGeom.Camera, through which a DCC application shows the asset as it was captured.

Source: OpenUSD, UsdGeomCamera: apertures, focal length and their units.
"""

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom

from stage.camera import Camera

FILM_WIDTH_M = 0.036
"""Width of the film gate. Only its ratio to the focal length is known; 36 mm is what DCCs start from."""

APERTURE_UNIT = 0.1
"""USD gives focal lengths and apertures in tenths of a scene unit (UsdGeomCamera, "Units of Measure")."""

ORTHOGRAPHIC_CLEARANCE = 0.5
"""Distance of an orthographic camera from the surface, in image widths; its image does not depend on it."""


def define_camera(usd_stage: Usd.Stage, path: Sdf.Path, camera: Camera, extent: np.ndarray) -> UsdGeom.Camera:
    """Define a camera at the origin of the camera frame whose picture is exactly the image.

    Args:
        extent: [2, 3] bounding box of the surface, camera frame, scene units; it sets the clipping range, and where
            an orthographic camera stands.

    Convention:
        Lens distortion has no place in a UsdGeomCamera: the camera is the ideal one, as the mesh is.
    """
    prim = UsdGeom.Camera.Define(usd_stage, path)
    cu, cv = camera.principal_px or (camera.width / 2, camera.height / 2)
    if camera.projection == "perspective":
        assert camera.focal_px is not None  # the camera's validator saw to it
        film_width = FILM_WIDTH_M / UsdGeom.GetStageMetersPerUnit(usd_stage)
        focal = film_width * camera.focal_px[0] / camera.width
        pixel = focal / camera.focal_px[0], focal / camera.focal_px[1]  # size on the film, scene units
        prim.CreateProjectionAttr(UsdGeom.Tokens.perspective)
        prim.CreateFocalLengthAttr(focal / APERTURE_UNIT)
        nearest, farthest = -float(extent[1, 2]), -float(extent[0, 2])
        prim.CreateClippingRangeAttr(Gf.Vec2f(nearest / 2, farthest * 2))
    else:
        pixel = (camera.pixel_size_m or 1.0,) * 2
        prim.CreateProjectionAttr(UsdGeom.Tokens.orthographic)
        clearance = ORTHOGRAPHIC_CLEARANCE * camera.width * pixel[0]
        depth = float(extent[1, 2] - extent[0, 2])
        prim.AddTranslateOp().Set(Gf.Vec3d(0, 0, float(extent[1, 2]) + clearance))
        prim.CreateClippingRangeAttr(Gf.Vec2f(clearance / 2, 2 * (clearance + depth)))
    prim.CreateHorizontalApertureAttr(camera.width * pixel[0] / APERTURE_UNIT)
    prim.CreateVerticalApertureAttr(camera.height * pixel[1] / APERTURE_UNIT)
    prim.CreateHorizontalApertureOffsetAttr((camera.width / 2 - cu) * pixel[0] / APERTURE_UNIT)
    prim.CreateVerticalApertureOffsetAttr((cv - camera.height / 2) * pixel[1] / APERTURE_UNIT)
    return prim
