"""What other programs' validators find in an asset: every variant of it, and for .usdz the rules of ARKit.

Source: OpenUSD up to 25, pxr/usd/usdUtils/complianceChecker.py, rules with ARKit in their names (they are in no wheel of usd-core).
"""

from itertools import product
from pathlib import Path, PurePosixPath
from zipfile import ZipFile

import MaterialX
import pytest
from pxr import Usd, UsdGeom, UsdShade, UsdValidation

ARKIT_FILES = {".usdc", ".png", ".jpg", ".jpeg"}
ARKIT_PRIMS = {"", "Scope", "Xform", "Camera", "Shader", "Material", "Mesh", "Points", "GeomSubset", "NodeGraph"}
"""The types that a capture's asset may need; ARKit knows solids, skeletons and sounds too, and no lights."""
ARKIT_SHADERS = {"UsdPreviewSurface", "UsdUVTexture", "UsdTransform2d", "UsdPrimvarReader_float2", "UsdPrimvarReader_float",
                 "UsdPrimvarReader_float3"}


def findings(path: Path) -> list[str]:
    """Return what UsdValidation, usd-validation-nvidia, MaterialX and ARKit's rules find in an asset: errors and warnings; none is right.

    MaterialX documents are those beside the layer.
    """
    usd_validation_nvidia = pytest.importorskip("usd_validation_nvidia", reason="usd-validation-nvidia is not installed")
    issues = usd_validation_nvidia.ValidationEngine().validate(str(path)).issues()
    found = [f"NVIDIA: {issue.severity.name} {issue.message}" for issue in issues]
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    for usd_stage, selected in with_variants(path):
        for each in UsdValidation.ValidationContext(validators).Validate(usd_stage):
            found.append(f"UsdValidation, {selected}: {each.GetName()} {each.GetMessage()}")
        if path.suffix == ".usdz":
            found += [f"ARKit, {selected}: {each}" for each in _arkit(usd_stage)]
    for document in path.parent.rglob("*.mtlx"):
        found += [f"MaterialX: {each}" for each in _materialx(document)]
    if path.suffix == ".usdz":
        with ZipFile(path) as package:
            names = package.namelist()
        found += [f"ARKit: {name} is of a type that it does not read" for name in names
                  if PurePosixPath(name).suffix.lower() not in ARKIT_FILES]
        if PurePosixPath(names[0]).suffix != ".usdc":
            found.append(f"ARKit: the root layer {names[0]} is not binary")
    return found


def with_variants(path: Path):
    """Yield the stage with each choice of the root's variants, and the choice."""
    usd_stage = Usd.Stage.Open(str(path))
    usd_stage.SetEditTarget(usd_stage.GetSessionLayer())
    sets = usd_stage.GetDefaultPrim().GetVariantSets()
    names = sets.GetNames()
    for choice in product(*(sets.GetVariantSet(name).GetVariantNames() for name in names)):
        for name, variant in zip(names, choice, strict=True):
            sets.GetVariantSet(name).SetVariantSelection(variant)
        yield usd_stage, "/".join(choice) or "as it is"


def _materialx(path: Path):
    document, libraries = MaterialX.createDocument(), MaterialX.createDocument()
    MaterialX.readFromXmlFile(document, str(path))
    MaterialX.loadLibraries(MaterialX.getDefaultDataLibraryFolders(), MaterialX.getDefaultDataSearchPath(), libraries)
    document.setDataLibrary(libraries)
    valid, message = document.validate()
    if not valid:
        yield message
    for node in document.getNodes():
        if node.getNodeDef() is None:
            yield f"{node.getName()}: no definition of {node.getCategory()}"
    for element in document.traverseTree():
        if element.isA(MaterialX.Input) and element.getType() == "filename" and not (path.parent / element.getValueString()).is_file():
            yield f"{element.getNamePath()}: there is no file {element.getValueString()}"


def _arkit(usd_stage: Usd.Stage):
    if UsdGeom.GetStageUpAxis(usd_stage) != UsdGeom.Tokens.y:
        yield "the up axis is not Y"
    if not usd_stage.GetDefaultPrim():
        yield "there is no default prim"
    if usd_stage.GetRootLayer().GetCompositionAssetDependencies():
        yield "the root layer refers to other layers"
    for prim in usd_stage.Traverse():
        if str(prim.GetTypeName()) not in ARKIT_PRIMS:
            yield f"{prim.GetPath()} is a {prim.GetTypeName()}, which it does not know"
        if prim.IsA(UsdShade.Shader):
            shader = UsdShade.Shader(prim)
            if shader.GetImplementationSource() != UsdShade.Tokens.id or shader.GetIdAttr().Get() not in ARKIT_SHADERS:
                yield f"{prim.GetPath()} is a shader {shader.GetIdAttr().Get()}, which it does not know"
        if prim.IsA(UsdGeom.Gprim) and prim.HasAPI(UsdShade.MaterialBindingAPI) \
                and not UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()[0]:
            yield f"{prim.GetPath()} is bound to no material"
