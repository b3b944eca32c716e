"""Primvars of vertices and points, with indices where values repeat.

Source: OpenUSD, UsdGeomPrimvar ("Indexed Primvars"); validators ask for indices where a value of a primvar repeats.
"""

import numpy as np
from pxr import Sdf, UsdGeom, Vt

_ARRAYS = {
    Sdf.ValueTypeNames.FloatArray: Vt.FloatArray,
    Sdf.ValueTypeNames.Color3fArray: Vt.Vec3fArray,
}


def set_primvar(prim: UsdGeom.Gprim, name: str, kind: Sdf.ValueTypeName, values: np.ndarray) -> None:
    """Set a primvar of vertices or points, or of the whole prim where one value is given.

    Args:
        prim: a mesh or points.
        name: without "primvars:".
        kind: FloatArray or Color3fArray.
        values: [n] or [n, 3]; n is the count of vertices or points, or 1.
    """
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
