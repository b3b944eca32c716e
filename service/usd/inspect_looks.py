"""Facts about the materials of an asset: workflow, inputs and textures.

Source: OpenUSD, "UsdPreviewSurface Specification" (useSpecularWorkflow, UsdUVTexture); UsdShade (render contexts, connections).
"""

import tempfile
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import OpenImageIO as oiio
from pxr import Ar, Sdf, UsdShade

from service.usd.inspect_geometry import FIRST

UNIVERSAL = "universal"
"""The render context of materials for all renderers."""


@dataclass(frozen=True)
class TextureFacts:
    """An image that an input of a surface reads; without size and depth where the image cannot be read."""

    file: str
    """As the layer says it."""
    found: bool
    color_space: str | None
    """What the texture is told to be read as: sourceColorSpace, or colorSpace of the file."""
    width: int | None = None
    height: int | None = None
    channels: int | None = None
    depth: str | None = None
    """uint8, uint16, half or float."""
    size_bytes: int | None = None


@dataclass(frozen=True)
class InputFacts:
    """An input of a surface: a texture, or a value."""

    name: str
    value: str | None
    texture: TextureFacts | None


@dataclass(frozen=True)
class SurfaceFacts:
    """A surface shader of a material."""

    context: str
    """The render context: universal, mtlx …"""
    shader: str
    workflow: str | None
    """metallic or specular, of a UsdPreviewSurface."""
    inputs: tuple[InputFacts, ...]


@dataclass(frozen=True)
class MaterialFacts:
    """A material."""

    path: str
    surfaces: tuple[SurfaceFacts, ...]

    def textures(self) -> Iterator[TextureFacts]:
        """Yield the texture of each input that has one."""
        for surface in self.surfaces:
            yield from (entry.texture for entry in surface.inputs if entry.texture is not None)


def material_facts(material: UsdShade.Material) -> MaterialFacts:
    """Return the facts about a material."""
    surfaces = []
    for output in material.GetSurfaceOutputs():
        producers = UsdShade.Utils.GetValueProducingAttributes(output)
        if not producers:
            continue
        shader = UsdShade.Shader(producers[0].GetPrim())
        context = output.GetBaseName().removesuffix("surface").removesuffix(":") or UNIVERSAL
        surfaces.append(SurfaceFacts(context, str(shader.GetIdAttr().Get() or "no identifier"), _workflow(shader),
                                     tuple(_input(entry) for entry in shader.GetInputs())))
    return MaterialFacts(str(material.GetPath()), tuple(surfaces))


def _workflow(shader: UsdShade.Shader) -> str | None:
    if shader.GetIdAttr().Get() != "UsdPreviewSurface":
        return None
    switch = shader.GetInput("useSpecularWorkflow")
    return "specular" if switch and switch.Get() == 1 else "metallic"


def _input(entry: UsdShade.Input) -> InputFacts:
    file = _file_of(entry, set())
    if file is not None:
        return InputFacts(entry.GetBaseName(), None, _texture(file))
    value = entry.Get(FIRST)
    return InputFacts(entry.GetBaseName(), None if value is None else str(value), None)


def _file_of(entry: UsdShade.Input, seen: set[Sdf.Path]) -> UsdShade.Input | None:
    """Return the input `file` of the texture that an input is connected to, through any nodes between, or None."""
    for producer in UsdShade.Utils.GetValueProducingAttributes(entry):
        shader = UsdShade.Shader(producer.GetPrim())
        if not shader or producer.GetPath() == entry.GetAttr().GetPath() or shader.GetPath() in seen:
            continue
        seen.add(shader.GetPath())
        file = shader.GetInput("file")
        if file:
            return file
        for inner in shader.GetInputs():
            found = _file_of(inner, seen)
            if found is not None:
                return found
    return None


def _texture(file: UsdShade.Input) -> TextureFacts:
    asset = file.GetAttr().Get(FIRST)
    declared = UsdShade.Shader(file.GetPrim()).GetInput("sourceColorSpace")
    color_space = (declared.Get() if declared else None) or file.GetAttr().GetColorSpace() or None
    if asset is None or not asset.resolvedPath:
        return TextureFacts(asset.path if asset else "", False, color_space)
    with tempfile.TemporaryDirectory() as folder:
        try:
            path = _on_disk(asset.resolvedPath, Path(folder))
            size = path.stat().st_size
        except (OSError, KeyError, zipfile.BadZipFile):
            return TextureFacts(asset.path, False, color_space)
        image = oiio.ImageInput.open(str(path))
        if image is None:
            oiio.geterror()  # else OpenImageIO prints it at the end of the program
            return TextureFacts(asset.path, True, color_space, size_bytes=size)
        spec = image.spec()
        image.close()
    return TextureFacts(asset.path, True, color_space, spec.width, spec.height, spec.nchannels, str(spec.format), size)


def _on_disk(resolved: str, folder: Path) -> Path:
    """Return the path of a file; one that lies in a package is written into the folder first."""
    if not Ar.IsPackageRelativePath(resolved):
        return Path(resolved)
    package, inner = Ar.SplitPackageRelativePathInner(resolved)
    with zipfile.ZipFile(package) as archive:
        return Path(archive.extract(inner, folder))
