"""Inspection of a USD asset for relit inspect: the facts that a technical director checks, and every finding of the validators.

Source: OpenUSD: UsdModelAPI, UsdGeomModelAPI, UsdGeomCamera (units of apertures), UsdValidation.
"""

from collections.abc import Callable, Container, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pxr import Ar, Gf, Sdf, Tf, Usd, UsdGeom, UsdLux, UsdShade, UsdUtils, UsdValidation

from service.asset.errors import AssetError
from service.usd.camera import APERTURE_UNIT
from service.usd.inspect_geometry import FIRST, MeshFacts, PointsFacts, mesh_facts, points_facts
from service.usd.inspect_looks import MaterialFacts, material_facts
from service.usd.inspect_package import arkit_findings, package_findings
from service.usd.layers import GEO, LOOK, PURPOSES

SUFFIXES = (".usda", ".usdc", ".usd", ".usdz")

HINT_TOLERANCE = 1e-4
"""How far extentsHint may be from the geometry, as a part of its size: more than float32 rounds."""


@dataclass(frozen=True)
class CameraFacts:
    """A camera."""

    path: str
    projection: str
    framing: str
    """The angle of view, or the width and height of the picture in metres."""


@dataclass(frozen=True)
class Inspection:
    """What an asset holds, and what is wrong with it."""

    file: str
    size_bytes: int
    """Bytes of the asset and of all files that it refers to."""
    layers: tuple[str, ...]
    """Layers beyond the first, relative to its folder."""
    default_prim: str | None
    kind: str | None
    asset_info: dict[str, str]
    notes: dict[str, str]
    """customData of the default prim, as relit:scale where the capture has none."""
    up_axis: str
    meters_per_unit: float
    time_codes: tuple[float, float, float] | None
    """First and last, and how many a second; None where nothing is timed."""
    extent_m: tuple[tuple[float, ...], tuple[float, ...]] | None
    """Lowest and highest corner of the bounding box in the world, metres."""
    variants: dict[str, tuple[str, ...]]
    """The variants of each set."""
    selections: dict[str, str]
    meshes: dict[str, tuple[MeshFacts, ...]]
    """By `geo=variant`; under an empty name where there is no such set."""
    points: dict[str, tuple[PointsFacts, ...]]
    materials: dict[str, tuple[MaterialFacts, ...]]
    """Materials that something is bound to, by `set=variant`: those of each look, and what other variants of `geo` bind beside them."""
    lights: dict[str, tuple[str, ...]]
    """Paths and types, by `set=variant` of the other sets; under an empty name where there are no others."""
    cameras: tuple[CameraFacts, ...]
    provenance: dict[str, str]
    """customLayerData."""
    validators: int
    """How many validators of OpenUSD looked at each variant."""
    warnings: tuple[str, ...]
    errors: tuple[str, ...]


def inspect_asset(path: Path) -> Inspection:
    """Open an asset, look at each of its variants, and run every validator on them.

    Raises:
        AssetError: it is no USD file, or one that cannot be opened.
        StorageError: it cannot be read.
    """
    if path.is_dir():
        raise AssetError(f"{path} is a folder: give the asset, a file that ends with {', '.join(SUFFIXES)}")
    if not path.exists():
        raise AssetError(f"{path} is not there")
    if path.suffix.lower() not in SUFFIXES:
        raise AssetError(f"{path}: relit inspect reads {', '.join(SUFFIXES)} and .glb")
    packed = path.suffix.lower() == ".usdz"
    errors = package_findings(path) if packed else []
    quiet = UsdUtils.CoalescingDiagnosticDelegate()  # what USD would print about missing files is among the findings
    try:
        usd_stage = Usd.Stage.Open(str(path))
    except Tf.ErrorException as error:
        raise AssetError(f"{path} cannot be opened: it is no USD file, or a damaged one") from error
    warnings = arkit_findings(path, usd_stage.GetRootLayer()) if packed else []
    usd_stage.SetEditTarget(usd_stage.GetSessionLayer())
    inspection = _inspect(usd_stage, path, warnings, errors)
    del quiet
    return inspection


def _inspect(usd_stage: Usd.Stage, path: Path, warnings: list[str], errors: list[str]) -> Inspection:
    root = usd_stage.GetDefaultPrim()
    if not root:
        errors.append("the layer has no default prim, so that nothing can refer to it")
    unit_m = UsdGeom.GetStageMetersPerUnit(usd_stage)
    meshes, points, materials = {}, {}, {}
    for variant in _each_variant(root, LOOK):
        materials[_chosen(LOOK, variant)] = _materials(usd_stage, ())
        _find(usd_stage, root, warnings, errors)
    for variant in _each_variant(root, GEO):
        chosen = _chosen(GEO, variant)
        meshes[chosen] = tuple(mesh_facts(UsdGeom.Mesh(prim)) for prim in usd_stage.Traverse() if prim.IsA(UsdGeom.Mesh))
        points[chosen] = tuple(points_facts(UsdGeom.Points(prim), unit_m) for prim in usd_stage.Traverse() if prim.IsA(UsdGeom.Points))
        own = _materials(usd_stage, {material.path for known in materials.values() for material in known})
        materials.update({chosen: own} if own else {})
        _find(usd_stage, root, warnings, errors)
    lights = {}
    for name in [name for name in (root.GetVariantSets().GetNames() if root else []) if name not in (GEO, LOOK)] or [""]:
        for variant in _each_variant(root, name):
            lights[_chosen(name, variant)] = tuple(
                f"{prim.GetPath()} ({prim.GetTypeName()})" for prim in usd_stage.Traverse() if prim.HasAPI(UsdLux.LightAPI))
            _find(usd_stage, root, warnings, errors)
    start, end = usd_stage.GetStartTimeCode(), usd_stage.GetEndTimeCode()
    layers, files, _ = UsdUtils.ComputeAllDependencies(str(path))  # of every variant
    others = [layer for layer in layers if layer != usd_stage.GetRootLayer()]
    packed = path.suffix.lower() == ".usdz"
    places = {Path(Ar.SplitPackageRelativePathOuter(str(file))[0]) for file in [*(each.realPath for each in others), *files]}
    places -= {path.resolve(), path}
    size = path.stat().st_size + (0 if packed else sum(place.stat().st_size for place in places if place.is_file()))
    sets = root.GetVariantSets() if root else None
    return Inspection(
        file=str(path), size_bytes=size, layers=tuple(sorted(_relative(layer, path) for layer in others)),
        default_prim=str(root.GetPath()) if root else None, kind=(Usd.ModelAPI(root).GetKind() or None) if root else None,
        asset_info=dict(_flat(Usd.ModelAPI(root).GetAssetInfo())) if root else {},
        notes=dict(entry for spec in reversed(root.GetPrimStack()) for entry in _flat(spec.customData)) if root else {},
        up_axis=str(UsdGeom.GetStageUpAxis(usd_stage)), meters_per_unit=unit_m,
        time_codes=(start, end, usd_stage.GetTimeCodesPerSecond()) if usd_stage.HasAuthoredTimeCodeRange() else None,
        extent_m=_extent(root, unit_m) if root else None,
        variants={name: tuple(sets.GetVariantSet(name).GetVariantNames()) for name in sets.GetNames()} if sets else {},
        selections=dict(sets.GetAllVariantSelections()) if sets else {},
        meshes=meshes, points=points, materials=materials, lights=lights,
        cameras=tuple(_camera(UsdGeom.Camera(prim), unit_m) for prim in usd_stage.Traverse() if prim.IsA(UsdGeom.Camera)),
        provenance=dict(_flat(usd_stage.GetRootLayer().customLayerData)), validators=len(_validators()),
        warnings=tuple(sorted(set(warnings))),
        errors=tuple(sorted(set(errors))))  # sorted: validators run side by side


def _each_variant(root: Usd.Prim, name: str) -> Iterator[str]:
    """Select each variant of a set in turn, the selected one first; then restore the selection. Yield "" where there is no such set."""
    names = root.GetVariantSets().GetNames() if root else []
    if name not in names:
        yield ""
        return
    variants = root.GetVariantSets().GetVariantSet(name)
    selected = variants.GetVariantSelection()
    for variant in sorted(variants.GetVariantNames(), key=lambda each: (each != selected, each)):
        variants.SetVariantSelection(variant)
        yield variant
    variants.ClearVariantSelection()


def _chosen(variant_set: str, variant: str) -> str:
    """Return how a variant is written; nothing where there is none."""
    return f"{variant_set}={variant}" if variant else ""


def _materials(usd_stage: Usd.Stage, known: Container[str]) -> tuple[MaterialFacts, ...]:
    """Return the materials that are bound to geometry, each once, without those whose path is known."""
    bound: dict[Sdf.Path, MaterialFacts] = {}
    for prim in usd_stage.Traverse():
        if prim.IsA(UsdGeom.Gprim) or prim.IsA(UsdGeom.Subset):
            material, _ = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()
            if material and material.GetPath() not in bound and str(material.GetPath()) not in known:
                bound[material.GetPath()] = material_facts(material)
    return tuple(bound.values())


def _find(usd_stage: Usd.Stage, root: Usd.Prim, warnings: list[str], errors: list[str]) -> None:
    """Add what the validators find in the selected variants, and whether extentsHint is right."""
    for found in UsdValidation.ValidationContext(_validators()).Validate(usd_stage):
        sentence = f"{found.GetName()}: {' '.join(found.GetMessage().split())}"
        if found.GetType() == UsdValidation.ValidationErrorType.Error:
            errors.append(sentence)
        else:
            warnings.append(sentence)
    hint = UsdGeom.ModelAPI(root).GetExtentsHint() if root else None
    box = _bounds(root, UsdGeom.BBoxCache.ComputeUntransformedBound) if root else Gf.Range3d()
    if hint and not box.IsEmpty():
        if len(hint) % 2:
            errors.append(f"extentsHint of {root.GetPath()} has {len(hint)} corners: it has two for each purpose")
            return
        given = Gf.Range3d()
        for low, high in zip(hint[::2], hint[1::2], strict=True):  # of each purpose
            given.UnionWith(Gf.Range3d(Gf.Vec3d(low), Gf.Vec3d(high)))
        tolerance = HINT_TOLERANCE * max(box.GetSize().GetLength(), 1e-12)
        if _distance(box, given) > tolerance:
            errors.append(f"extentsHint of {root.GetPath()} is {given}, and the geometry of the selected variants fills {box}")


def _validators() -> list[UsdValidation.Validator]:
    return UsdValidation.ValidationRegistry().GetOrLoadAllValidators()


def _bounds(root: Usd.Prim, compute: Callable[[UsdGeom.BBoxCache, Usd.Prim], Gf.BBox3d]) -> Gf.Range3d:
    """Return the bounding box of the geometry below a prim, of every purpose."""
    return compute(UsdGeom.BBoxCache(FIRST, PURPOSES), root).ComputeAlignedRange()


def _distance(one: Gf.Range3d, other: Gf.Range3d) -> float:
    return float(max(np.abs(np.array(one.GetMin()) - other.GetMin()).max(), np.abs(np.array(one.GetMax()) - other.GetMax()).max()))


def _extent(root: Usd.Prim, unit_m: float) -> tuple[tuple[float, ...], tuple[float, ...]] | None:
    box = _bounds(root, UsdGeom.BBoxCache.ComputeWorldBound)
    return None if box.IsEmpty() else (tuple(unit_m * each for each in box.GetMin()), tuple(unit_m * each for each in box.GetMax()))


def _camera(camera: UsdGeom.Camera, unit_m: float) -> CameraFacts:
    gf_camera = camera.GetCamera(FIRST)
    if gf_camera.projection == Gf.Camera.Orthographic:
        width, height = (APERTURE_UNIT * aperture * unit_m for aperture in (gf_camera.horizontalAperture, gf_camera.verticalAperture))
        return CameraFacts(str(camera.GetPath()), "orthographic", f"{width:.6g} × {height:.6g} m")
    angles = (gf_camera.GetFieldOfView(direction) for direction in (Gf.Camera.FOVHorizontal, Gf.Camera.FOVVertical))
    return CameraFacts(str(camera.GetPath()), "perspective", " × ".join(f"{angle:.4g}°" for angle in angles))


def _flat(data: dict[str, object], prefix: str = "") -> Iterator[tuple[str, str]]:
    """Yield the entries of nested dictionaries as texts, the keys joined by colons, as USD takes them apart."""
    for key, value in sorted(data.items()):
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{key}:")
        else:
            yield f"{prefix}{key}", value.path if isinstance(value, Sdf.AssetPath) else str(value)


def _relative(layer: Sdf.Layer, path: Path) -> str:
    folder = f"{path.resolve().parent}/"
    return str(layer.identifier).removeprefix(folder).removeprefix(f"{path.parent}/")
