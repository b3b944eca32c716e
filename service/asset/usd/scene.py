"""The prims of geometry (meshes, points and their primvars) and of the capturing camera, through which a DCC application shows the
asset as it was captured.

An orthographic capture has a second, perspective camera, so far away that it shows the same picture: Blender 5.0 takes the aperture of an
orthographic camera, which is in tenths of a scene unit, as its width in metres, and so shows ten times as much in each direction.

Source: OpenUSD, UsdGeomMesh, UsdGeomPoints, UsdGeomPrimvar ("Indexed Primvars"): validators ask for indices where a value repeats;
UsdGeomCamera: apertures, focal length and their units.
"""

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, Vt

from service.asset.content.mesh import SurfaceMesh
from service.asset.content.surface import ORTHOGRAPHIC_CLEARANCE, view_of
from stage.capture.camera import Camera

_ARRAYS = {Sdf.ValueTypeNames.FloatArray: Vt.FloatArray, Sdf.ValueTypeNames.Color3fArray: Vt.Vec3fArray}
CAMERA, FAR_CAMERA = "Camera", "CameraPerspective"
"""Names of the prims."""

FILM_WIDTH_M = 0.036
"""Width of the film gate. Only its ratio to the focal length is known; 36 mm is what DCCs start from."""

APERTURE_UNIT = 0.1
"""USD gives focal lengths and apertures in tenths of a scene unit (UsdGeomCamera, "Units of Measure")."""

PARALLAX_PX = 0.05
"""The largest distance in pixels between the images of a surface point in the far and in the orthographic camera."""


def define_mesh(usd_stage: Usd.Stage, path: Sdf.Path, mesh: SurfaceMesh) -> UsdGeom.Mesh:
    """Define the polygons with normals and texture coordinates."""
    usd_mesh = define_polygons(usd_stage, path, mesh.points, mesh.normals, mesh.face_counts, mesh.face_indices)
    coordinates = UsdGeom.PrimvarsAPI(usd_mesh).CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray,
                                                              UsdGeom.Tokens.vertex)
    coordinates.Set(Vt.Vec2fArray.FromNumpy(mesh.st))
    return usd_mesh


def define_polygons(usd_stage: Usd.Stage, path: Sdf.Path, points: np.ndarray, normals: np.ndarray, counts: np.ndarray,
                    indices: np.ndarray) -> UsdGeom.Mesh:
    """Define polygons with normals, of which `counts` has the corners of each face and `indices` the vertex numbers of all."""
    usd_mesh = UsdGeom.Mesh.Define(usd_stage, path)
    usd_mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    usd_mesh.CreateDoubleSidedAttr(True)
    usd_mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points))
    usd_mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(counts))
    usd_mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(indices.astype(np.int32)))
    usd_mesh.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(np.stack([points.min(axis=0), points.max(axis=0)])))
    usd_mesh.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(normals))
    usd_mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    return usd_mesh


def set_primvar(prim: UsdGeom.Gprim, name: str, kind: Sdf.ValueTypeName, values: np.ndarray) -> None:
    """Set a primvar of vertices or points, FloatArray or Color3fArray, or of the whole prim where one value is given."""
    interpolation = UsdGeom.Tokens.constant if len(values) == 1 else UsdGeom.Tokens.vertex
    primvar = UsdGeom.PrimvarsAPI(prim).CreatePrimvar(name, kind, interpolation)
    first, index = distinct(values)
    repeated = len(first) < len(values)
    primvar.Set(_ARRAYS[kind].FromNumpy(np.ascontiguousarray(values[first] if repeated else values, dtype=np.float32)))
    if repeated:
        primvar.SetIndices(Vt.IntArray.FromNumpy(index.astype(np.int32)))


def distinct(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return where each different value stands first, and for each value the number of the one that it equals."""
    columns = values.reshape(len(values), -1).T
    key = np.zeros(len(values), dtype=np.int64)
    for column in columns:  # at most as many keys as values, so that the product of two counts stays below 2^63
        _, part = np.unique(column, return_inverse=True)
        _, key = np.unique(key * (int(part.max(initial=0)) + 1) + part, return_inverse=True)
    _, first, index = np.unique(key, return_index=True, return_inverse=True)
    return first, index


def define_points(usd_stage: Usd.Stage, path: Sdf.Path, points: np.ndarray, widths: np.ndarray, *,
                  normals: np.ndarray | None) -> UsdGeom.Points:
    """Define points with widths [n], or [1] for points of one width."""
    prim = UsdGeom.Points.Define(usd_stage, path)
    prim.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(points, dtype=np.float32)))
    each_width = Vt.FloatArray.FromNumpy(np.broadcast_to(widths, len(points)).astype(np.float32))
    prim.CreateWidthsAttr(each_width)  # one a point: readers that compute an extent give up on one for all
    prim.SetWidthsInterpolation(UsdGeom.Tokens.vertex)
    prim.CreateExtentAttr(UsdGeom.Points.ComputeExtent(prim.GetPointsAttr().Get(), each_width))
    if normals is not None:
        prim.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(normals, dtype=np.float32)))
        prim.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    return prim


def define_cameras(usd_stage: Usd.Stage, root: Sdf.Path, camera: Camera, extent: np.ndarray) -> None:
    """Define, below the root, the camera whose picture is exactly the image, and for an orthographic one its far perspective twin.
    `extent`: [2, 3] bounding box of the surface, camera frame, scene units; it sets the clipping ranges, and where the cameras of an
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
