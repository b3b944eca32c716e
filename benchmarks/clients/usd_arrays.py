"""Reads the meshes and materials of a USD asset as arrays, as OpenUSD says they are to be read, for renderers without a USD reader.

Source: OpenUSD, "UsdPreviewSurface Specification" (inputs and their defaults; UsdUVTexture: sourceColorSpace, scale, bias), UsdGeomMesh.
"""

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
from pxr import Ar, Gf, Usd, UsdGeom, UsdShade

from stage.colour.colour import convert

INPUTS = {"diffuseColor": (0.18, 0.18, 0.18), "metallic": 0.0, "roughness": 0.5, "normal": (0.0, 0.0, 1.0), "opacity": 1.0, "ior": 1.5}
"""The inputs that are read, and their values where the material says nothing."""
COLOURS = ("diffuseColor",)


def read(path: Path) -> dict[str, np.ndarray]:
    """Return arrays by name: of mesh i `i.points` [V, 3] metres in the world, `i.normals` [V, 3], `i.st` [V, 2], `i.triangles` [T, 3];
    of its material each of INPUTS, a value or an image [rows, cols, channels] float32, colours in scene-linear Rec.709.

    Raises:
        RuntimeError: the asset cannot be opened, or has no mesh, or a material of the specular workflow.
    """
    usd_stage = Usd.Stage.Open(str(path))
    unit = UsdGeom.GetStageMetersPerUnit(usd_stage)
    arrays: dict[str, np.ndarray] = {}
    count = 0
    for prim in usd_stage.Traverse():
        if prim.IsA(UsdGeom.Mesh) and UsdGeom.Imageable(prim).ComputeVisibility() != UsdGeom.Tokens.invisible \
                and UsdGeom.Imageable(prim).ComputePurpose() in (UsdGeom.Tokens.default_, UsdGeom.Tokens.render):
            material, _ = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()
            found = _mesh(UsdGeom.Mesh(prim), unit) | _material(material)
            arrays |= {f"{count}.{name}": value for name, value in found.items()}
            count += 1
    if count == 0:
        raise RuntimeError(f"{path}: has no mesh")
    return arrays


def _mesh(mesh: UsdGeom.Mesh, unit: float) -> dict[str, np.ndarray]:
    world = np.array(UsdGeom.Xformable(mesh).ComputeLocalToWorldTransform(Usd.TimeCode.Default()))  # row vectors
    points, normals = np.array(mesh.GetPointsAttr().Get(), float), np.array(mesh.GetNormalsAttr().Get(), float)
    counts, indices = np.array(mesh.GetFaceVertexCountsAttr().Get()), np.array(mesh.GetFaceVertexIndicesAttr().Get())
    starts = np.cumsum(counts) - counts
    triangles = [indices[starts[counts > corner][:, None] + [0, corner - 1, corner]] for corner in range(2, counts.max())]
    st = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st")
    turned = normals @ np.linalg.inv(world[:3, :3]).T
    return {"points": ((points @ world[:3, :3] + world[3, :3]) * unit).astype(np.float32),
            "normals": (turned / np.linalg.norm(turned, axis=-1, keepdims=True)).astype(np.float32),
            "triangles": np.concatenate(triangles).astype(np.uint32),
            "st": np.array(st.ComputeFlattened() if st else np.zeros((len(points), 2)), np.float32)}


def _material(material: UsdShade.Material) -> dict[str, np.ndarray]:
    values = {name: np.array(value, np.float32) for name, value in INPUTS.items()}
    if not material:
        return values
    surface, _, _ = material.ComputeSurfaceSource()
    workflow = surface.GetInput("useSpecularWorkflow")
    if workflow and workflow.Get() == 1:
        raise RuntimeError("the material has the specular workflow, which Mitsuba's principled BSDF does not know")
    for name in INPUTS:
        given = surface.GetInput(name)
        if not given:
            continue
        attributes = given.GetValueProducingAttributes()
        prim = attributes[0].GetPrim() if attributes else None
        if prim is not None and prim != surface.GetPrim() and UsdShade.Shader(prim).GetIdAttr().Get() == "UsdUVTexture":
            values[name] = _texture(UsdShade.Shader(prim), attributes[0].GetBaseName(), colour=name in COLOURS)
        elif attributes:
            values[name] = np.array(attributes[0].Get(), np.float32)
    return values


def _texture(texture: UsdShade.Shader, output: str, *, colour: bool) -> np.ndarray:
    """Return the values of one output of a UsdUVTexture, [rows, cols, channels]; the top row first."""
    def get(name: str, default: Any) -> Any:
        given = texture.GetInput(name)
        attributes = given.GetValueProducingAttributes() if given else []
        value = attributes[0].Get() if attributes else None
        return default if value is None else value

    file = texture.GetInput("file").GetValueProducingAttributes()[0]
    image = _pixels(file.Get())
    image = image if image.ndim == 3 else image[..., None]
    if image.shape[2] == 1:
        image = np.repeat(image, 3, axis=2)
    space = get("sourceColorSpace", "auto")
    declared = _declared_space(file)
    if colour:
        rgb = np.ascontiguousarray(image[..., :3])
        if space == "sRGB" or (space == "auto" and file.Get().path.endswith((".png", ".jpg"))):
            rgb = convert(rgb, "srgb_texture", "lin_rec709_scene")
        elif declared.startswith("lin_") and declared != "lin_rec709_scene":
            rgb = convert(rgb, declared, "lin_rec709_scene")
        image = np.concatenate([rgb, image[..., 3:]], axis=-1)
    channels = {"rgb": slice(0, 3), "r": slice(0, 1), "g": slice(1, 2), "b": slice(2, 3), "a": slice(3, 4)}[output]
    scale, bias = (np.array(get(name, default), np.float32)[channels] for name, default in (("scale", Gf.Vec4f(1)), ("bias", Gf.Vec4f(0))))
    return (image[..., channels] * scale + bias).astype(np.float32)


def _declared_space(file: Usd.Attribute) -> str:
    """Return the colour space of an attribute, or of the nearest prim that says one (UsdColorSpaceAPI); empty where none does."""
    if file.GetColorSpace():
        return str(file.GetColorSpace())
    prim = file.GetPrim()
    while prim and not prim.IsPseudoRoot():
        name = prim.GetAttribute("colorSpace:name").Get()
        if name:
            return str(name)
        prim = prim.GetParent()
    return ""


def _pixels(asset: Any) -> np.ndarray:
    """Return the pixels of an image, which may lie in a package, as float32 without any conversion."""
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / f"image{Path(asset.path).suffix}"
        with Ar.GetResolver().OpenAsset(Ar.ResolvedPath(asset.resolvedPath)) as opened:
            copy.write_bytes(opened.GetBuffer())
        config = oiio.ImageSpec()
        config.attribute("oiio:UnassociatedAlpha", 1)  # colours as recorded, not multiplied by alpha
        source = oiio.ImageInput.open(str(copy), config)
        if source is None:
            raise RuntimeError(f"{asset.path}: {oiio.geterror()}")
        pixels = np.array(source.read_image(0, 0, 0, source.spec().nchannels, oiio.FLOAT))
        source.close()
        return pixels
