"""Faults of meshes and points that no validator of OpenUSD finds: numbers that are not finite, faces of vertices that are not there, and
arrays that do not have an entry for each vertex, face or corner.

Source: OpenUSD, UsdGeomMesh (ValidateTopology), UsdGeomPrimvar (interpolation, elementSize, indexed primvars).
"""

from collections.abc import Iterator

import numpy as np
from pxr import Usd, UsdGeom

FIRST = Usd.TimeCode.EarliestTime()
TEXTURE_COORDINATES = "TextureCoordinate"
"""The role of the type of values that say where on a texture a vertex lies."""


def geometry_faults(usd_stage: Usd.Stage) -> Iterator[str]:
    """Yield a sentence for each fault of the geometry of the selected variants, at the first time."""
    for prim in usd_stage.Traverse():
        if not (prim.IsA(UsdGeom.Mesh) or prim.IsA(UsdGeom.Points)):
            continue
        shape, sizes = UsdGeom.PointBased(prim), {}
        points, normals = (np.asarray(each.Get(FIRST) or []) for each in (shape.GetPointsAttr(), shape.GetNormalsAttr()))
        sizes["vertex"] = sizes["varying"] = len(points)
        if prim.IsA(UsdGeom.Mesh):
            counts, corners = (each.Get(FIRST) or [] for each in (UsdGeom.Mesh(prim).GetFaceVertexCountsAttr(),
                                                                  UsdGeom.Mesh(prim).GetFaceVertexIndicesAttr()))
            sizes["uniform"], sizes["faceVarying"] = len(counts), len(corners)
            valid, reason = UsdGeom.Mesh.ValidateTopology(corners, counts, len(points))
            if not valid:
                yield f"{prim.GetPath()}: its faces are wrong: {reason}"
        yield from _array_faults(f"{prim.GetPath()}.points", points, None, 1)
        if len(normals):
            yield from _array_faults(f"{prim.GetPath()}.normals", normals, sizes.get(shape.GetNormalsInterpolation()), 1)
        for primvar in UsdGeom.PrimvarsAPI(prim).GetPrimvarsWithValues():
            values = np.asarray(primvar.Get(FIRST))
            if not primvar.GetTypeName().isArray or not len(values):
                continue
            path, element = str(primvar.GetAttr().GetPath()), primvar.GetElementSize()
            finite = values if primvar.GetTypeName().role == TEXTURE_COORDINATES else np.zeros(0)
            if primvar.IsIndexed():
                indices = np.asarray(primvar.GetIndices(FIRST) or [], np.int64)
                if len(indices) and (indices.min() < 0 or indices.max() >= len(values) // element):
                    yield f"{path}: its indices run from {indices.min()} to {indices.max()}, and it has {len(values) // element} values"
                values, element = indices, 1
            yield from _array_faults(path, values, sizes.get(primvar.GetInterpolation()), element, finite)


def _array_faults(path: str, values: np.ndarray, wanted: int | None, element: int, finite: np.ndarray | None = None) -> Iterator[str]:
    """Yield what is wrong with values, of which `wanted` times `element` are needed (None: as many as there are), and with numbers."""
    if wanted is not None and len(values) != wanted * element:
        yield f"{path}: has {len(values)} values, and its interpolation needs {wanted * element}"
    numbers = values if finite is None else finite
    if len(numbers) and numbers.dtype.kind == "f" and (bad := int((~np.isfinite(numbers)).reshape(len(numbers), -1).any(axis=1).sum())):
        yield f"{path}: {bad} of its {len(numbers)} values are not finite (NaN or infinity)"
