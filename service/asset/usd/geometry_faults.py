"""Faults of meshes and points that no validator of OpenUSD finds: numbers that are not finite, faces of vertices that are not there,
arrays that do not have an entry for each vertex, face or corner, an extent that they do not fill, normals that are not of length 1, and
textures without coordinates.

Source: OpenUSD, UsdGeomMesh (ValidateTopology), UsdGeomPrimvar (interpolation, elementSize, indexed primvars), UsdGeomBoundable (extent);
UsdPreviewSurface specification, "Primvar Reader".
"""

from collections.abc import Iterator

import numpy as np
from pxr import Sdf, Usd, UsdGeom, UsdShade

from service.asset.content.surface import length_fault

FIRST = Usd.TimeCode.EarliestTime()
EXTENT_TOLERANCE = 1e-4
"""The largest deviation of an extent from the geometry, as a part of its size: more than float32 rounds."""
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
        yield from _extent_faults(shape)
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


def geometry_doubts(usd_stage: Usd.Stage) -> Iterator[str]:
    """Yield a sentence for each mesh of the selected variants that is shown otherwise than it was meant, at the first time."""
    for prim in usd_stage.Traverse():
        if prim.IsA(UsdGeom.Mesh):
            normals = np.asarray(UsdGeom.Mesh(prim).GetNormalsAttr().Get(FIRST) or [])
            if len(normals) and (fault := length_fault(normals)):
                yield f"{prim.GetPath()}.normals: {fault}"
            bound = [prim, *(each.GetPrim() for each in UsdGeom.Subset.GetAllGeomSubsets(UsdGeom.Mesh(prim)))]
            materials = {each.GetPath(): each for part in bound if (each := UsdShade.MaterialBindingAPI(part).ComputeBoundMaterial()[0])}
            primvars = UsdGeom.PrimvarsAPI(prim)
            for path, material in sorted(materials.items()):
                for name in sorted(_read_primvars(material)):
                    if not primvars.FindPrimvarWithInheritance(name).HasValue():
                        yield f"{prim.GetPath()}: has no primvar {name}, by which its material {path} reads textures: none shows"


def _read_primvars(material: UsdShade.Material) -> set[str]:
    """Return the primvars by which a material, its surface for all renderers, reads textures, without those that have a fallback."""
    found, seen = set[str](), set[Sdf.Path]()
    waiting = [each.GetPrim() for each in UsdShade.Utils.GetValueProducingAttributes(material.GetSurfaceOutput())]
    while waiting:
        shader = UsdShade.Shader(waiting.pop())
        if not shader or shader.GetPath() in seen:
            continue
        seen.add(shader.GetPath())
        name, substitute = shader.GetInput("varname"), shader.GetInput("fallback")
        if shader.GetIdAttr().Get() == "UsdPrimvarReader_float2" and name and not (substitute and substitute.GetAttr().HasAuthoredValue()):
            found |= {str(value) for each in UsdShade.Utils.GetValueProducingAttributes(name) if (value := each.Get(FIRST))}
        waiting += [each.GetPrim() for entry in shader.GetInputs() for each in UsdShade.Utils.GetValueProducingAttributes(entry)]
    return found


def _extent_faults(shape: UsdGeom.PointBased) -> Iterator[str]:
    """Yield how the extent of a shape differs from what its points, with their widths, fill; viewers frame and cull by it."""
    given, filled = shape.GetExtentAttr().Get(FIRST), UsdGeom.Boundable.ComputeExtentFromPlugins(shape, FIRST)
    if given and filled and len(given) == len(filled) == 2 and np.isfinite(filled).all():
        far, size = np.abs(np.subtract(given, filled)).max(), np.ptp(np.asarray(filled), axis=0).max()
        if not far <= EXTENT_TOLERANCE * max(float(size), 1e-12):
            words = [f"({', '.join(f'{float(value):.5g}' for value in corner)})" for corner in (*given, *filled)]
            yield f"{shape.GetPath()}.extent: is from {words[0]} to {words[1]}, and the geometry from {words[2]} to {words[3]}"


def _array_faults(path: str, values: np.ndarray, wanted: int | None, element: int, finite: np.ndarray | None = None) -> Iterator[str]:
    """Yield what is wrong with values, of which `wanted` times `element` are needed (None: as many as there are), and with numbers."""
    if wanted is not None and len(values) != wanted * element:
        yield f"{path}: has {len(values)} values, and its interpolation needs {wanted * element}"
    numbers = values if finite is None else finite
    if len(numbers) and numbers.dtype.kind == "f" and (bad := int((~np.isfinite(numbers)).reshape(len(numbers), -1).any(axis=1).sum())):
        yield f"{path}: {bad} of its {len(numbers)} values are not finite (NaN or infinity)"
