"""Inspection of a USD asset for relit inspect: what it holds, and every finding of OpenUSD's validators in each of its variants.

Source: OpenUSD: UsdModelAPI, UsdGeomModelAPI, UsdGeomCamera (units of apertures), UsdShade (render contexts, connections), UsdValidation;
Apple, "Creating USD files for Apple devices": the root layer of a package is binary and refers to no other layer.
"""

import zipfile
from collections.abc import Iterator
from os.path import relpath
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Ar, Gf, Sdf, Tf, Usd, UsdGeom, UsdLux, UsdShade, UsdUtils, UsdValidation

from service.asset.content.surface import Inspection, Part, image_facts, size_doubts, texture_doubts, texture_faults
from service.asset.usd.files import reason_of
from service.asset.usd.geometry_faults import geometry_doubts, geometry_faults
from service.asset.usd.layers import PURPOSES
from service.asset.usd.scene import APERTURE_UNIT
from service.errors import AssetError
from stage.errors import storage

FIRST = Usd.TimeCode.EarliestTime()
"""The time at which an asset with time samples is inspected."""
HINT_TOLERANCE = 1e-4
"""The largest deviation of extentsHint from the geometry, as a part of its size: more than float32 rounds."""


def inspect_usd(path: Path) -> Inspection:
    """Open an asset, look at each of its variants, and run every validator on them."""
    warnings = _check_package(path) if path.suffix.lower() == ".usdz" else []
    quiet = UsdUtils.CoalescingDiagnosticDelegate()  # what USD would print about missing files is among the findings
    try:
        usd_stage = Usd.Stage.Open(str(path))
    except Tf.ErrorException as error:
        raise AssetError(f"{path} cannot be opened: it is no USD file, or a damaged one: {reason_of(error)}") from error
    if path.suffix.lower() == ".usdz" and (others := sorted(usd_stage.GetRootLayer().GetCompositionAssetDependencies())):
        warnings.append(f"ARKit takes packages of one layer, and the root layer of this one refers to {', '.join(others)}")
    usd_stage.SetEditTarget(usd_stage.GetSessionLayer())
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    errors, parts = list[str](), dict[str, Part]()
    for variant in _each_variant(usd_stage.GetDefaultPrim()):
        for part in _parts(usd_stage, variant):
            parts.setdefault(repr((part.kind, part.name, part.facts)), part)
        for found in UsdValidation.ValidationContext(validators).Validate(usd_stage):
            wrong = found.GetType() == UsdValidation.ValidationErrorType.Error
            (errors if wrong else warnings).append(f"{found.GetName()}: {' '.join(found.GetMessage().split())}")
        errors += _hint_findings(usd_stage.GetDefaultPrim())
        errors += geometry_faults(usd_stage)
        warnings += geometry_doubts(usd_stage)
    errors += texture_faults(parts.values())
    warnings += texture_doubts(parts.values())
    layers, files, _ = UsdUtils.ComputeAllDependencies(str(path))  # of every variant
    beside = {Path(Ar.SplitPackageRelativePathOuter(str(file))[0]).resolve() for file in [*(layer.realPath for layer in layers), *files]}
    size = sum(file.stat().st_size for file in beside | {path.resolve()} if file.is_file())
    names = sorted(relpath(layer.realPath or layer.identifier, path.parent) for layer in layers if layer != usd_stage.GetRootLayer())
    facts = _facts(usd_stage)
    if any(part.kind == "mesh" for part in parts.values()):
        told = "" if usd_stage.HasAuthoredMetadata("metersPerUnit") else ", which it does not say,"
        warnings += size_doubts(facts.get("extent_m"), f"its metersPerUnit{told} is {facts['meters_per_unit']:g}")
    inspection = Inspection(
        str(path), size, {**facts, "layers": names, "validators": len(validators)}, tuple(parts.values()),
        dict(_flat(usd_stage.GetRootLayer().customLayerData)), tuple(sorted(set(warnings))), tuple(sorted(set(errors))))
    del quiet
    return inspection


def _check_package(path: Path) -> list[str]:
    """Refuse what is no package, or a damaged one, and return why ARKit does not take its root layer."""
    with storage("read", path):
        try:
            with zipfile.ZipFile(path) as archive, archive.open(archive.infolist()[0]) as layer:
                damaged, binary = archive.testzip(), layer.read(8) == b"PXR-USDC"
        except (zipfile.BadZipFile, NotImplementedError, EOFError, IndexError) as error:
            raise AssetError(f"{path} is no USDZ package, or only a part of one: {str(error).lower()}") from error
    if damaged is not None:
        raise AssetError(f"{path} is damaged: the checksum of {damaged} does not fit")
    return [] if binary else ["ARKit takes a binary root layer, and that of this package is text"]


def _facts(usd_stage: Usd.Stage) -> dict[str, Any]:
    root, unit_m = usd_stage.GetDefaultPrim(), UsdGeom.GetStageMetersPerUnit(usd_stage)
    facts = {"default_prim": str(root.GetPath()) if root else None, "up_axis": str(UsdGeom.GetStageUpAxis(usd_stage)),
             "meters_per_unit": unit_m}
    if usd_stage.HasAuthoredTimeCodeRange():
        facts["time_codes"] = [usd_stage.GetStartTimeCode(), usd_stage.GetEndTimeCode()]
        facts["time_codes_per_second"] = usd_stage.GetTimeCodesPerSecond()
    if root:
        sets, box = root.GetVariantSets(), UsdGeom.BBoxCache(FIRST, PURPOSES).ComputeWorldBound(root).ComputeAlignedRange()
        repeated = set(_flat(usd_stage.GetRootLayer().customLayerData))
        facts |= {"kind": Usd.ModelAPI(root).GetKind() or None,
                  "asset_info": dict(entry for entry in _flat(Usd.ModelAPI(root).GetAssetInfo()) if entry not in repeated),
                  "notes": dict(entry for spec in reversed(root.GetPrimStack()) for entry in _flat(spec.customData)),
                  "extent_m": None if box.IsEmpty() else [[unit_m * each for each in corner] for corner in (box.GetMin(), box.GetMax())],
                  "variants": {name: list(sets.GetVariantSet(name).GetVariantNames()) for name in sets.GetNames()},
                  "selections": dict(sets.GetAllVariantSelections())}
    return facts


def _each_variant(root: Usd.Prim) -> Iterator[str]:
    """Select each variant of each set in turn, beside the first selections of other sets, and yield it; these come first, as ""."""
    yield ""
    for name in root.GetVariantSets().GetNames() if root else []:
        variants = root.GetVariantSets().GetVariantSet(name)
        selected = variants.GetVariantSelection()
        for variant in variants.GetVariantNames():
            if variant != selected:
                variants.SetVariantSelection(variant)
                yield f"{name}={variant}"
        variants.ClearVariantSelection()


def _parts(usd_stage: Usd.Stage, variant: str) -> Iterator[Part]:
    """Yield the geometry, lights, cameras and bound materials of the selected variants."""
    unit_m = UsdGeom.GetStageMetersPerUnit(usd_stage)
    for prim in usd_stage.Traverse():
        path = str(prim.GetPath())
        if prim.IsA(UsdGeom.Mesh) or prim.IsA(UsdGeom.Points):
            is_mesh, shape = prim.IsA(UsdGeom.Mesh), UsdGeom.PointBased(prim)
            sizes = (UsdGeom.Mesh(prim).GetFaceVertexCountsAttr() if is_mesh else UsdGeom.Points(prim).GetWidthsAttr()).Get(FIRST) or []
            yield Part("mesh" if is_mesh else "points", path, variant, {
                "vertices": len(shape.GetPointsAttr().Get(FIRST) or []),
                **({"faces": len(sizes)} if is_mesh else {"widths_m": [unit_m * edge(sizes, default=0) for edge in (min, max)]}),
                "purpose": str(shape.ComputePurpose()),
                "primvars": [f"{each.GetPrimvarName()} {each.GetInterpolation()}"
                             for each in UsdGeom.PrimvarsAPI(prim).GetPrimvarsWithValues()]})
        elif prim.HasAPI(UsdLux.LightAPI):
            yield Part("light", path, variant, {"type": str(prim.GetTypeName())})
        elif prim.IsA(UsdGeom.Camera):
            lens = UsdGeom.Camera(prim).GetCamera(FIRST)
            sides = [APERTURE_UNIT * unit_m * side for side in (lens.horizontalAperture, lens.verticalAperture)]
            angles = [lens.GetFieldOfView(side) for side in (Gf.Camera.FOVHorizontal, Gf.Camera.FOVVertical)]
            flat = lens.projection == Gf.Camera.Orthographic
            yield Part("camera", path, variant, {"orthographic_m": sides} if flat else {"perspective_degrees": angles})
        if prim.IsA(UsdGeom.Gprim) or prim.IsA(UsdGeom.Subset):
            material, _ = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()
            if material:
                yield from _material(material, variant)


def _material(material: UsdShade.Material, variant: str) -> Iterator[Part]:
    """Yield the surfaces of a material by their render contexts, and the texture of each input that has one."""
    for output in material.GetSurfaceOutputs():
        for producer in UsdShade.Utils.GetValueProducingAttributes(output)[:1]:
            shader = UsdShade.Shader(producer.GetPrim())
            context = output.GetBaseName().removesuffix("surface").removesuffix(":") or "universal"
            files = {entry.GetBaseName(): _file_of(entry, set()) for entry in shader.GetInputs()}
            values = {entry.GetBaseName(): str(entry.Get(FIRST)) for entry in shader.GetInputs()
                      if files[entry.GetBaseName()] is None and entry.Get(FIRST) is not None}
            yield Part("material", str(material.GetPath()), variant,
                       {"context": context, "shader": str(shader.GetIdAttr().Get() or "no identifier"), **values})
            for name, file in files.items():
                if file is not None:
                    yield Part("texture", f"{material.GetPath()} {context}:{name}", variant, _texture(file))


def _file_of(entry: UsdShade.Input, seen: set[Sdf.Path]) -> UsdShade.Input | None:
    """Return the input `file` of the texture that an input is connected to, through any nodes between, or None."""
    for producer in UsdShade.Utils.GetValueProducingAttributes(entry):
        shader = UsdShade.Shader(producer.GetPrim())
        if not shader or producer.GetPath() == entry.GetAttr().GetPath() or shader.GetPath() in seen:
            continue
        seen.add(shader.GetPath())
        if file := shader.GetInput("file") or next(filter(None, (_file_of(inner, seen) for inner in shader.GetInputs())), None):
            return file
    return None


def _texture(file: UsdShade.Input) -> dict[str, Any]:
    asset = file.GetAttr().Get(FIRST)
    declared = UsdShade.Shader(file.GetPrim()).GetInput("sourceColorSpace")
    color_space = (declared.Get() if declared else None) or file.GetAttr().GetColorSpace() or None
    source = Ar.GetResolver().OpenAsset(Ar.ResolvedPath(asset.resolvedPath)) if asset is not None and asset.resolvedPath else None
    found = {"missing": True} if source is None else image_facts(bytes(source.GetBuffer()), asset.path)
    return {"file": asset.path if asset is not None else "", "color_space": color_space, **found}


def _hint_findings(root: Usd.Prim) -> Iterator[str]:
    """Yield how extentsHint, two corners for each purpose, differs from the geometry of the selected variants."""
    hint = list(UsdGeom.ModelAPI(root).GetExtentsHint() or []) if root else []
    if not hint:
        return
    box, given = UsdGeom.BBoxCache(FIRST, PURPOSES).ComputeUntransformedBound(root).ComputeAlignedRange(), Gf.Range3d()
    for low, high in zip(hint[::2], hint[1::2], strict=False):
        given.UnionWith(Gf.Range3d(Gf.Vec3d(low), Gf.Vec3d(high)))
    far = np.abs(np.subtract([*box.GetMin(), *box.GetMax()], [*given.GetMin(), *given.GetMax()])).max()
    if len(hint) % 2 or (not box.IsEmpty() and far > HINT_TOLERANCE * max(box.GetSize().GetLength(), 1e-12)):
        yield f"extentsHint of {root.GetPath()} is {given} in {len(hint)} corners, and the geometry of the selected variants fills {box}"


def _flat(data: dict[str, object], prefix: str = "") -> Iterator[tuple[str, str]]:
    """Yield the entries of nested dictionaries as texts, the keys joined by colons, as USD takes them apart."""
    for key, value in sorted(data.items()):
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{key}:")
        else:
            yield f"{prefix}{key}", value.path if isinstance(value, Sdf.AssetPath) else str(value)
